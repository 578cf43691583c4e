"""Support for magnetometer chips on I2C, with one module per chip or manufacturer."""
