"""Stages of the pipeline: each takes one record at a time and returns the resulting records."""
