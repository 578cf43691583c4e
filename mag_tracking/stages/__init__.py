"""Stages of the pipeline.

Each stage processes one record or one batch of readings at a time, and returns the resulting
records.
"""
