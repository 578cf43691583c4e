"""Transports: reception of bytes, and polled chips, one file per protocol."""
