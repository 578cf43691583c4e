"""Calibration of sensors and networks: background, noise, iron, orientation, clocks, geometry."""
