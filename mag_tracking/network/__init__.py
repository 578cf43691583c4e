"""The sensor network and its file."""

from mag_tracking.network.sensor_network import Calibrated, SensorNetwork

__all__ = ['Calibrated', 'SensorNetwork']
