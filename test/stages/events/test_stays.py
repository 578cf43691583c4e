"""Stays of parked vehicles: one event with the right duration, whatever the rate."""

import numpy as np
import pytest

import mag_tracking as mt
from mag_tracking.pipeline import settings_for
from mag_tracking.records import Readings
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.events.stage import Events
from mag_tracking.units import NS
from support.bundled import NETWORK_FILE

NETWORK = mt.read_network(NETWORK_FILE)
FREE = NETWORK.R_sw[0] @ NETWORK.earth_field
VEHICLE = np.array([4e-6, -9e-6, 14e-6])
EPOCH_NS = 1_790_000_000 * NS


def events_of(rate, duration_s, *stays, ramp_s=0.0, batch=64):
    """Events of mag_1; each stay is (begin [s], end [s], share of `VEHICLE`).

    With a ramp, the field rises and falls with the inverse cube of the distance.
    """
    rng = np.random.default_rng(0)
    t = np.arange(0.0, duration_s, 1.0 / rate)
    field = FREE + rng.normal(0.0, 3e-8, (len(t), 3))
    for begin, end, share in stays:
        near = np.clip(np.minimum(t - begin, end - t) / ramp_s, 0.0, 1.0) if ramp_s \
            else ((begin < t) & (t < end)).astype(float)
        field += share * np.where(near > 0.0, (4.0 - 3.0 * near) ** -3.0, 0.0)[:, None] * VEHICLE
    readings = Readings(('mag_1',), np.zeros(len(t), dtype=np.int64),
                        EPOCH_NS + np.round(t * NS).astype(np.int64), field)
    settings = settings_for('vehicle')
    calibrate = Calibrate(NETWORK, settings.calibrate)
    events, out = Events(NETWORK, settings.align, settings.detect, settings.track), []
    for k in range(0, len(t), batch):
        for calibrated in calibrate.feed(readings.part(slice(k, k + batch))):
            events.set_relearnt(calibrate.backgrounds())
            out += events.feed(calibrated)
    return sorted(out + events.flush(), key=lambda event: event.onset_ns)


def times_of(event):
    """Begin and end of an event [s]."""
    return ((event.onset_ns - EPOCH_NS) / NS, (event.release_ns - EPOCH_NS) / NS)


@pytest.mark.parametrize('rate, ramp_s', [(0.1, 0.0), (0.5, 0.0), (1.0, 6.0), (5.0, 6.0),
                                          (25.0, 8.0)])
def test_a_stay_is_one_event(rate, ramp_s):
    """The first stay is longer than `calibrate.relearn_s`, the second one is shorter."""
    stays = (600.0, 1500.0, 1.0), (1900.0, 1985.0, 0.7)
    events = events_of(rate, 2300.0, *stays, ramp_s=ramp_s)
    assert len(events) == 2
    for event, (begin, end, _) in zip(events, stays, strict=True):
        assert event.ended
        # The times are uncertain by the interval and by the ramps, of which the field is small.
        np.testing.assert_allclose(times_of(event), (begin, end), atol=2.0 / rate + ramp_s)


def test_a_stay_while_another_vehicle_stands():
    events = events_of(0.1, 5 * 3600, (3600, 10800, 1.0), (5400, 7200, 0.3))
    np.testing.assert_allclose([times_of(e) for e in events],
                               [(3600, 10800), (5400, 7200)], atol=20.0)


def test_a_vehicle_that_does_not_leave():
    (event,) = events_of(0.1, 3600, (1800, np.inf, 1.0))
    assert not event.ended
    np.testing.assert_allclose(times_of(event), (1800, 3590), atol=20.0)


def test_a_vehicle_that_stands_at_the_start():
    """The Earth's field shows that the vehicle has left, and has not arrived."""
    first, second = events_of(0.1, 8000, (-1, 1900, 1.0), (4000, 5500, 1.0))
    assert times_of(first)[1] == pytest.approx(1900, abs=20.0)
    np.testing.assert_allclose(times_of(second), (4000, 5500), atol=20.0)


@pytest.mark.parametrize('rate', [0.1, 1.0])
def test_a_slow_sensor_shows_no_direction(rate):
    events = events_of(rate, 3600, (600, 1800, 1.0), (2400, 2460, 1.0))
    assert len(events) == 2
    assert all(e.left_to_right == 0.5 and np.isinf(e.closest_std) for e in events)


def test_another_vehicle_takes_the_place():
    events = events_of(0.1, 9000, (3600, 4800, 1.0), (4830, 6000, 1.0))
    np.testing.assert_allclose([times_of(e) for e in events],
                               [(3600, 4800), (4830, 6000)], atol=20.0)


def test_a_field_below_the_uncertainty_of_the_background_is_one_stay():
    """After 480 s the background may have drifted by more than a third of the field."""
    events = events_of(1 / 30, 12 * 3600, (14400, 18000, 0.08), (28800, 29700, 0.08))
    np.testing.assert_allclose([times_of(e) for e in events],
                               [(14400, 18000), (28800, 29700)], atol=60.0)
