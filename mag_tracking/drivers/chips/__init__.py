"""Magnetometer chips on I2C, one file for each manufacturer or chip."""
