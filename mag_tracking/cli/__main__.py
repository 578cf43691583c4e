"""Entry point of `python -m mag_tracking.cli`."""

from mag_tracking.cli import command

command()
