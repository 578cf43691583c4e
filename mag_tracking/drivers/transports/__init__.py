"""Transports: how bytes reach this machine, one file each."""
