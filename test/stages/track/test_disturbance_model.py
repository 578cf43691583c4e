"""Disturbance model: evidence for common fields and for independent fields, and handovers."""

import dataclasses

import numpy as np
import pytest

from mag_tracking.physics.dipole import dipole_field
from mag_tracking.records import FieldFrame
from mag_tracking.stages.track.disturbances import DisturbanceModel
from support.networks import line_network

NOISE = 4e-9


def frames(network, fields, dt=0.08, seed=0):
    """Create [`FieldFrame`] with noise from fields (n, n_sensors, 3) [T] in the world frame."""
    rng = np.random.default_rng(seed)
    seen = np.einsum('jik,nji->njk', network.R_ws, fields)
    seen = seen + NOISE * rng.standard_normal(seen.shape)
    n = len(network)
    return [FieldFrame(round(k * dt * 1e9), y, np.tile(NOISE**2 * np.eye(3), (n, 1, 1)),
                       np.ones(n, dtype=int), np.zeros(n)) for k, y in enumerate(seen)]


def total_log_density(model, sequence, dt=0.08):
    no_error = np.zeros(len(sequence[0].field))
    return sum(model.log_density(f, dt if k else 0.0, no_error) or 0.0
               for k, f in enumerate(sequence))


def slow_waves(t, network, own):
    """Fields (n, n_sensors, 3) [T] of slow waves: a different one at each sensor if `own`, else a
    common one."""
    rng = np.random.default_rng(3)
    size = 2e-7 * rng.standard_normal((len(network), 3))
    if not own:
        size = np.tile(size[:1], (len(network), 1))
    phase = rng.uniform(0.0, 6.0, len(network)) if own else np.zeros(len(network))
    return np.sin(t[:, None] + phase)[:, :, None] * size


@pytest.mark.parametrize('n_sensors', [2, 4, 10])
@pytest.mark.parametrize('own', [True, False])
def test_a_uniform_field_is_distinguished_from_independent_fields(n_sensors, own):
    network = line_network(n_sensors)
    model = DisturbanceModel(network, 2e-8)
    fields = slow_waves(np.arange(0.0, 8.0, 0.08), network, own)
    # The backgrounds have errors of the configured standard deviation.
    offsets = 2e-8 * np.random.default_rng(1).standard_normal((n_sensors, 3))
    total_log_density(model, frames(network, fields - fields[0] + offsets))
    assert model.uniform < 1e-3 if own else model.uniform > 0.999


def test_a_field_with_a_gradient_over_the_network_counts_as_uniform():
    network = line_network(6)
    away = network.positions - network.centre
    G = np.array([[1.0, 0.5, 0.2], [0.5, -1.5, 0.3], [0.2, 0.3, 0.5]])
    wave = np.sin(np.arange(0.0, 8.0, 0.08))[:, None, None]
    shape = 2e-7 * np.array([1.0, -0.5, 0.7]) + 6e-9 * away @ G
    model = DisturbanceModel(network, 2e-8)
    total_log_density(model, frames(network, wave * shape))
    assert model.uniform > 0.999


def test_the_evidence_falls_with_the_speed_of_a_passing_dipole():
    network = line_network(2)
    t = np.arange(-3.0, 3.0, 0.08)
    explained = []
    for speed in (4.0, 8.0, 16.0):
        r = np.stack([speed * t, 0.0 * t - 1.0, 0.0 * t + 0.5], axis=1)
        passing = dipole_field(network.positions - r[:, None], np.array([200.0, 100.0, -300.0]))
        # The field starts at zero.
        passing -= passing[0]
        explained.append(total_log_density(DisturbanceModel(network, 2e-8),
                                           frames(network, passing)[20:-20]))
    assert -np.diff(explained).max() > np.log(20.0)


def test_missing_axes_and_sensors_are_ignored():
    network = line_network(2)
    sequence = frames(network, slow_waves(np.arange(0.0, 4.0, 0.08), network, True))
    without = [dataclasses.replace(f, field=np.where(
        [[False, False, True], [True, True, True]], np.nan, f.field)) for f in sequence]
    of_two_axes = total_log_density(DisturbanceModel(network, 2e-8), without)
    assert np.isfinite(of_two_axes) and of_two_axes < total_log_density(
        DisturbanceModel(network, 2e-8), sequence)
    nothing = [dataclasses.replace(f, field=np.full((2, 3), np.nan)) for f in sequence]
    assert total_log_density(DisturbanceModel(network, 2e-8), nothing) == 0.0


def test_the_first_frame_after_a_handover_is_not_compared():
    network = line_network(2)
    field = 1e-6 + slow_waves(np.arange(0.0, 4.0, 0.08), network, True)
    sequence = frames(network, field)
    model, no_error = DisturbanceModel(network, 2e-8, is_handover=True), np.zeros(2)
    assert model.log_density(sequence[0], 0.0, no_error) is None
    # Afterwards, the evidence equals the evidence without the jump, except for the cost of an
    # unknown rate of change.
    rest = sum(model.log_density(f, 0.08, no_error) for f in sequence[1:])
    before = DisturbanceModel(network, 2e-8)
    smooth = frames(network, field - 1e-6)
    before.log_density(smooth[0], 0.0, no_error)
    assert rest == pytest.approx(sum(before.log_density(f, 0.08, no_error) for f in smooth[1:]),
                                 abs=60.0)


@pytest.mark.parametrize('gap_s', [2.0, 20.0, 60.0])
def test_the_evidence_stays_finite_over_gaps_with_rotated_sensors(gap_s):
    """Each update correlates all components of the field.

    If one triangle of each covariance were not copied to the other, rounding errors would make the
    covariance indefinite.
    """
    network, rng = line_network(4), np.random.default_rng(2)
    R = np.linalg.qr(rng.standard_normal((4, 3, 3)))[0]
    network = dataclasses.replace(
        network, R_ws=R * np.sign(np.linalg.det(R))[:, None, None])
    model = DisturbanceModel(network, 5e-9)
    C = np.tile(1.6e-17 * np.eye(3), (4, 1, 1))
    for k in range(2500):
        field = network.R_sw @ (1e-6 * np.sin(0.05 * k) * np.array([1.0, 0.5, -0.3])) \
            + 4e-9 * rng.standard_normal((4, 3))
        frame = FieldFrame(k, field, C, np.ones(4, dtype=np.int64), np.zeros(4))
        assert np.isfinite(model.log_density(frame, gap_s if k % 50 == 49 else 0.08, np.zeros(4)))
