"""Scenarios with truth."""
