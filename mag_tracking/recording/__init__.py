"""Recordings and other files: read, write, record, repair, import."""
