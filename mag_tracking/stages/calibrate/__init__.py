"""Calibrate: raw readings to calibrated ones."""
