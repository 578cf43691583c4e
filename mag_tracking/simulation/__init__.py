"""Simulated scenarios with ground truth."""
