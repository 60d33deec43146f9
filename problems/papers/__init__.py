"""Published results, done again with km: one file for the papers of the same authors, or a folder."""
