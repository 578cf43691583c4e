"""Health: detect faults in the readings of a sensor."""
