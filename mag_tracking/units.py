"""Units at the edges: everything inside is SI, and time is integer nanoseconds."""

NS = 1_000_000_000
"""Nanoseconds in a second."""
