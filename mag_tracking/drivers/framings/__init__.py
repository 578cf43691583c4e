"""Framings: from bytes to readings, one file a format; each is pure."""
