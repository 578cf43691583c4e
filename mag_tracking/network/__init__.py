"""The sensor network, its file, and the counting lines."""

from mag_tracking.network.sensor_network import CalibrationRecord, SensorNetwork

__all__ = ['CalibrationRecord', 'SensorNetwork']
