"""Questions asked of a whole pass or of a network, not of a stream: fits, bounds, placement."""
