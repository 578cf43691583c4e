"""Survey: estimate the orientations and clock offsets of the sensors of a network."""
