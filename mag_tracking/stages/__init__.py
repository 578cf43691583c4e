"""Stages of the pipeline: each processes one record or batch of readings at a time."""
