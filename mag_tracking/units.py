"""Units and time constants: internal quantities are in SI units, timestamps in integer nanoseconds.
"""

NS = 1_000_000_000
"""Nanoseconds per second."""
NEVER = -2**63
"""Timestamp of an event that has not happened: the smallest int64 [ns]."""
LATEST_NS = 2**31 * NS
"""Upper bound of the timestamps in ROS headers [ns]. Differences of timestamps between -LATEST_NS
and LATEST_NS fit into int64, and no such timestamp equals `NEVER`."""
