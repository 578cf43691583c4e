"""Framings that extract readings from bytes, with one module per format."""
