"""Traffic: vehicles that cross lines, their classes, and statistics of intervals."""
