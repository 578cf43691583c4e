"""Transports, which receive bytes, and the polled I2C bus; one module per protocol."""
