"""Selection of the source of a sensor's readings."""

import numpy as np
import pytest

from mag_tracking.drivers.sensor_checks import (
    MAX_SENDERS,
    MIN_SECONDS,
    RELEASE_TIMEOUT_S,
    SingleSource,
    contest,
)

DEVICE, STRAY = ('', '10.0.0.5'), ('', '10.0.0.66')
S = 1_000_000_000
RNG = np.random.default_rng(3)
DEVICES = {
    '64 Hz': np.arange(1.0, 61.0, 1 / 64),
    '5 Hz': np.arange(1.0, 61.0, 1 / 5),
    '50 Hz in packets of 10': np.repeat(np.arange(1.0, 61.0, 0.2), 10),
    '20 Hz with delays and a gap': np.sort(np.r_[np.arange(1.0, 21.0, 0.05), np.arange(
        22.5, 61.0, 0.05)] + RNG.exponential(0.03, 1170))}
STRAYS = {
    'every 4 s': np.arange(0.0, 61.0, 4.0),
    'every 1 s': np.arange(0.0, 61.0, 1.0),
    'irregular, 0.5 Hz': np.cumsum(RNG.exponential(2.0, 30)) - 1.0,
    'irregular, 2 Hz': np.cumsum(RNG.exponential(0.5, 120)) - 1.0,
    'one burst before the device': np.arange(0.0, 1.0, 0.01),
    'one message': np.array([0.0])}


def accepted(*sources):
    """Feed one selection with sources, each as (source, times [s]); return the selection and the
    accepted times of each source."""
    selection = SingleSource()
    times = {source: [] for source, _ in sources}
    for t, source in sorted((t, source) for source, own in sources for t in own.tolist()):
        if selection.accepts(source, round(t * S)):
            times[source].append(t)
    return selection, times


@pytest.mark.parametrize('stray', STRAYS)
@pytest.mark.parametrize('device', DEVICES)
def test_a_steady_device_is_selected_though_a_stray_source_came_first(device, stray):
    own = STRAYS[stray][STRAYS[stray] < 60.0]
    selection, times = accepted((STRAY, own), (DEVICE, DEVICES[device]))
    # The device starts after 1 s. From the moment of its selection on, it stays selected.
    assert times[DEVICE][0] <= 1.0 + RELEASE_TIMEOUT_S + 0.3
    assert len(times[DEVICE]) == np.count_nonzero(DEVICES[device] >= times[DEVICE][0])
    assert len(times[DEVICE]) >= 0.9 * len(DEVICES[device]) and selection.changes == 1


def test_a_stray_source_that_comes_later_is_never_selected():
    for stray in STRAYS.values():
        own = stray[stray < 55.0] + 5.0
        selection, times = accepted((DEVICE, DEVICES['64 Hz']), (STRAY, own))
        assert times[STRAY] == [] and selection.changes == 0


def test_two_equal_sources_do_not_alternate():
    own = np.arange(0.0, 100.0, 0.02)
    selection, times = accepted((DEVICE, own), (STRAY, own + 0.001 + RNG.uniform(0, 0.01, 5000)))
    assert selection.changes == 0 and times[STRAY] == []


def test_a_source_that_replaces_a_dead_one_is_selected():
    _, times = accepted((STRAY, np.arange(0.0, 10.0, 0.1)), (DEVICE, np.arange(10.0, 20.0, 0.1)))
    assert times[DEVICE][0] <= 10.0 + MIN_SECONDS + 0.2


def test_the_number_of_observed_sources_is_bounded_and_locks_no_device_out():
    flood = [(('', f'10.1.{k // 256}.{k % 256}'), np.array([k * 60 / 4096])) for k in range(4096)]
    selection, times = accepted(*flood, (DEVICE, DEVICES['64 Hz']))
    assert len(times[DEVICE]) >= 0.9 * len(DEVICES['64 Hz'])
    assert len(selection.rates_hz(round(61.0 * S))) <= MAX_SENDERS


def test_a_slow_source_is_kept_though_a_stray_message_comes_between():
    slow = np.arange(0.0, 3600.0, 60.0)
    selection, times = accepted((DEVICE, slow), (STRAY, np.arange(150.0, 3600.0, 600.0)))
    assert times == {DEVICE: slow.tolist(), STRAY: []} and selection.changes == 0


def test_silent_sources_are_forgotten_and_the_others_are_named():
    selection, _ = accepted((DEVICE, DEVICES['64 Hz']), (STRAY, np.array([4.0, 8.0])))
    # A message of this source may come every 4 s.
    rates = selection.rates_hz(round(19.0 * S))
    text = contest('mag_1', selection.selected, rates)
    assert set(rates) == {DEVICE, STRAY} and rates[STRAY] == pytest.approx(0.25)
    assert '10.0.0.5 (64 Hz, used)' in text and '10.0.0.66 (0.25 Hz, refused)' in text
    assert text.endswith('sensors: {10.0.0.5: mag_1}')
    rates = selection.rates_hz(round(21.0 * S))
    assert set(rates) == {DEVICE} and contest('mag_1', selection.selected, rates) == ''
