"""Transports: moving bytes to this machine, one file each."""
