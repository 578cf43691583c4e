"""Align: calibrated readings to frames of the whole network."""
