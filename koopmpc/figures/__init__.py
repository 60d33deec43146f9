"""Everything that touches matplotlib."""
