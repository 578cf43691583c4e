"""Framings: extraction of readings from bytes, one file per format. All are pure functions."""
