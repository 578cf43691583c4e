"""Detect: energy test on frames."""
