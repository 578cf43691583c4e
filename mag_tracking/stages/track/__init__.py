"""Tracking stage: turns frames with a detection verdict into tracks."""
