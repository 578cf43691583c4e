"""Figures of tracks, and what figures and pages share."""
