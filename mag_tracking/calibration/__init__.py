"""What a sensor must be corrected for, learnt from its own samples."""
