"""Sensor network: geometry, network file, topic names, Earth's field and counting lines."""

from mag_tracking.network.sensor_network import CalibrationRecord, SensorNetwork

__all__ = ['CalibrationRecord', 'SensorNetwork']
