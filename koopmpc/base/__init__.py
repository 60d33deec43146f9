"""Plain services of all rooms: errors, checks, values, text, disk, processes."""
