"""Analyses of a whole pass or a network: batch fits, bounds, sensor placement."""
