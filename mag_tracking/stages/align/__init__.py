"""Align: combine calibrated readings into frames of the whole network."""
