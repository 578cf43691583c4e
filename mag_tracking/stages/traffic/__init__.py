"""Traffic: passages of vehicles across counting lines, vehicle classes, and interval summaries."""
