"""Stages of the pipeline: each processes one record at a time and returns the resulting records."""
