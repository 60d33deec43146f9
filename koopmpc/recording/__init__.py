"""Everything that touches Rerun."""
