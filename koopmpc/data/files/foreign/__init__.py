"""Readers of logs that other tools write: a file a format, each behind an extra."""
