"""Calibrate: convert raw readings to calibrated readings."""
