"""Tracks and poses of magnetic targets from a network of stationary magnetometers."""

__version__ = '0.1.0'
