"""Figures and numbers about a run."""
