"""Detect: the energy test on frames."""
