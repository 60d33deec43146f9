"""Rows and columns of a log: writer and reader."""
