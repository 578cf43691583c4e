"""Drivers that read samples from sensor hardware over serial lines, UDP, MQTT and I2C."""
