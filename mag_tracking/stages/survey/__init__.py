"""Survey: orientations and clock offsets of a network."""
