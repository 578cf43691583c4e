"""Calibration of sensors from their own readings: background, noise, iron, orientation, clocks."""
