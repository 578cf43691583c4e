"""Batch analyses of passes and networks: fits, classification, calibration, sensor placement."""
