"""Traffic: count and classify the vehicles that cross counting lines, and summarise intervals."""
