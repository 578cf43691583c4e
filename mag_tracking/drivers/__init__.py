"""Drivers: samples from sensor hardware. One file per transport, framing or kind of chip."""
