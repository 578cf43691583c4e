"""Units at the edges: everything inside is SI, and time is integer nanoseconds."""

NS = 1_000_000_000
"""Nanoseconds in a second."""
NEVER = -2**63
"""[ns] Timestamp of an event that has not happened: the smallest int64."""
LATEST_NS = 2**31 * NS
"""[ns] Later than any timestamp of a ROS header. Of timestamps that are no further from 1970 every
difference fits into int64, and none is `NEVER`."""
