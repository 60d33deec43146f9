"""The figures of docs/speed.md: each measured in turns with its yardstick, and with the same figure of another commit."""
