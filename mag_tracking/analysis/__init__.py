"""Batch analyses of passes: fits, checks, classification and sensor placement."""
