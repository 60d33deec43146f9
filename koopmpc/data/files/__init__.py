"""Logs as files: formats and their readers, tables, folders of files as a source."""
