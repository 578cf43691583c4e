"""Detect: decide for each frame whether a target is present."""
