"""Transports that receive bytes, and the polled I2C bus, with one module per protocol."""
