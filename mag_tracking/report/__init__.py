"""Figures, tables, pages and metrics of a run."""
