"""Health: faults in the readings of a sensor."""
