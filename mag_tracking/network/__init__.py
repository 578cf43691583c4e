"""The sensor network and its file."""

from mag_tracking.network.sensor_network import CalibrationRecord, SensorNetwork

__all__ = ['CalibrationRecord', 'SensorNetwork']
