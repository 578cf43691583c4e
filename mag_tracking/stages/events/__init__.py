"""Events: passes described by each sensor alone."""
