"""Magnetometers on I2C, one file for each maker or chip; `chip.py` says what a chip has to do."""
