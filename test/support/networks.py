"""Sensor network along a road, for tests."""

import numpy as np

from mag_tracking.network import SensorNetwork


def line_network(n, spacing=9.0, earth=(2e-6, 1.55e-5, -4.9e-5), noise=1.2e-8, tilt=0.3):
    """Network of `n` sensors on both sides of a road, each with a random orientation."""
    rng = np.random.default_rng(n)
    positions = np.zeros((n, 3))
    positions[:, 0] = spacing * (np.arange(n) // 2)
    positions[:, 1] = np.where(np.arange(n) % 2, 4.5, -4.5)
    from mag_tracking.geometry import quaternion_from_rotation_vector, rotation_from_quaternion
    R = rotation_from_quaternion(
        quaternion_from_rotation_vector(tilt * rng.standard_normal((n, 3))))
    names = tuple(f'mag_{i + 1}' for i in range(n))
    return SensorNetwork(names, positions, R, tuple(f'/{name}/imu/mag' for name in names),
                         earth_field=np.array(earth), noise_std=(np.full(3, noise),) * n)
