"""Events: passes described by individual sensors."""
