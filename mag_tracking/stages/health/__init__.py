"""Health: what is wrong with the readings of a sensor."""
