"""Formats of results: tables, archives, fits, trajectories and recordings of tracks."""
