"""Recordings and other files: reading, writing, recording, repair and import."""
