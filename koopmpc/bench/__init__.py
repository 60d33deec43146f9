"""Problems, the sweep over controllers, the table."""
