"""Detection: thresholds, false alarm and detection rates, onset, hold and release."""

from dataclasses import fields

import numpy as np
import pytest
from scipy.stats import binom, chi2, ncx2

from mag_tracking.inference.covariances import smallest_pivots, whitened_energy
from mag_tracking.inference.detection_theory import (
    detection_probability,
    energy_threshold,
    false_alarm_probability,
)
from mag_tracking.records import Detection, FieldFrame
from mag_tracking.settings import replace
from mag_tracking.stages.align.stage import Align
from mag_tracking.stages.calibrate import stage as calibrate_stage
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.detect.stage import Detect
from mag_tracking.stages.settings import AlignSettings, CalibrateSettings, DetectSettings
from support.counters import count_of
from support.marks import studied
from support.networks import line_network
from support.samples import MagSample, one

SIGMA = 1.2e-8


def frame(k, field, network, period_ns=80_000_000):
    n = len(network)
    C = np.repeat(SIGMA**2 * np.eye(3)[None], n, axis=0)
    return FieldFrame(k * period_ns, np.asarray(field, dtype=float), C, np.ones(n, dtype=int),
                      np.zeros(n))


def detector(network, **changes):
    without_background_error = {'background_std': 0.0, 'background_drift': 0.0}
    return Detect(network, replace(DetectSettings(), {**without_background_error, **changes}))


def test_thresholds_match_the_published_thresholds():
    """T10 eq. (5.18), (5.19): threshold 11.2 (exact value 11.34), detection rate 0.5 at SNR 9.2."""
    h = energy_threshold(0.01, 3)
    assert h == pytest.approx(chi2.isf(0.01, 3), rel=1e-12)
    assert false_alarm_probability(h, 3) == pytest.approx(0.01, rel=1e-12)
    assert detection_probability(9.2, 11.2, 3) == pytest.approx(0.5, abs=0.01)
    assert detection_probability(9.2, h, 3) == pytest.approx(ncx2.sf(h, 3, 9.2), rel=1e-9)


@pytest.mark.parametrize('p', [1e-2, 1e-3])
def test_the_false_alarm_rate_is_as_configured(p):
    network, rng, n = line_network(2), np.random.default_rng(7), 60_000
    stage = detector(network, false_alarm_probability=p)
    for k in range(n):
        stage.feed(frame(k, SIGMA * rng.standard_normal((2, 3)), network))
    alarms = count_of(stage.counts, 'threshold')
    low, high = binom.ppf([0.005, 0.995], n, p)
    print(f'configured {p:g}: measured {alarms / n:.2e}, limits {low / n:.2e} .. {high / n:.2e}')
    assert low <= alarms <= high


@pytest.mark.parametrize('samples_per_frame, documented, tested', [
    (1, '3.5e-4 per frame of one sample (12.5 Hz)', 1e-3),
    (8, '1.5e-7 per frame of eight samples (100 Hz)', 0.05)])
def test_the_default_false_alarm_probability_is_as_documented(
        samples_per_frame, documented, tested):
    """The samples have 12 nT of noise, and `background_std` has its default."""
    settings, variance = DetectSettings(), SIGMA**2 / samples_per_frame
    variance_ratio = 1.0 + settings.background_std**2 / variance
    p = chi2.sf(chi2.isf(settings.false_alarm_probability, 6) * variance_ratio, 6)
    assert float(documented.split()[0]) == pytest.approx(p, rel=0.05)
    text, = (f.metadata['doc'] for f in fields(DetectSettings)
             if f.name == 'background_std')
    assert documented in text
    # The stage itself is tested with a probability that causes enough alarms to count.
    network, rng, n = line_network(2), np.random.default_rng(12), 60_000
    stage = Detect(network, replace(settings, {'false_alarm_probability': tested}))
    p = chi2.sf(chi2.isf(tested, 6) * variance_ratio, 6)
    C = np.repeat(variance * np.eye(3)[None], 2, axis=0)
    std = np.sqrt(variance)
    for k in range(n):
        y = std * rng.standard_normal((2, 3))
        stage.feed(FieldFrame(k * 80_000_000, y, C, np.full(2, samples_per_frame), np.zeros(2)))
    alarms = count_of(stage.counts, 'threshold')
    low, high = binom.ppf([0.005, 0.995], n, p)
    print(f'{samples_per_frame} samples per frame: computed {p:.2e}, measured {alarms / n:.2e}')
    assert low <= alarms <= high


@pytest.mark.parametrize('n', studied([40_000, 160_000], [40_000]))
def test_the_false_alarm_rate_is_as_configured_after_calibration_and_alignment(monkeypatch, n):
    """Raw noise at 100 Hz is calibrated with learnt backgrounds and aligned to 12.5 Hz frames."""
    network, rng = line_network(2), np.random.default_rng(8)
    monkeypatch.setattr(calibrate_stage, 'MEMORY_S', 300.0)
    calibrate = Calibrate(network, replace(CalibrateSettings(), {'learn_s': 60.0}))
    align = Align(network, AlignSettings())
    detectors = {p: detector(network, false_alarm_probability=p) for p in (1e-2, 1e-3)}
    noise = SIGMA * rng.standard_normal((n, 2, 3))
    background = np.array([[2e-6, 1.5e-5, -4.9e-5], [3e-6, 1.4e-5, -5e-5]])
    for k in range(n):
        for j, name in enumerate(network.names):
            sample = MagSample(k * 10_000_000, name, background[j] + noise[k, j])
            for f in [f for r in calibrate.feed(one(sample)) for f in align.feed(r)]:
                for stage in detectors.values():
                    stage.feed(f)
    for p, stage in detectors.items():
        frames, alarms = stage.counts['frames'], count_of(stage.counts, 'threshold')
        low, high = binom.ppf([0.005, 0.995], frames, p)
        print(f'all stages, configured {p:g}: measured {alarms / frames:.2e} of {frames}')
        assert low <= alarms <= high


def test_the_detection_rate_matches_theory():
    network, rng, n = line_network(2), np.random.default_rng(9), 20_000
    signal = SIGMA * np.array([[1.0, -2.0, 0.5], [0.0, 1.5, 2.0]])
    snr = float((signal**2).sum() / SIGMA**2)
    stage = detector(network, false_alarm_probability=1e-2)
    for k in range(n):
        stage.feed(frame(k, signal + SIGMA * rng.standard_normal((2, 3)), network))
    expected = detection_probability(snr, energy_threshold(1e-2, 6), 6)
    low, high = binom.ppf([0.005, 0.995], n, expected)
    assert low <= count_of(stage.counts, 'threshold') <= high


def test_the_energy_includes_only_present_axes():
    C = np.repeat((SIGMA**2 * np.array([[2, 1, 0], [1, 2, 0], [0, 0, 1.0]]))[None], 3, axis=0)
    y = SIGMA * np.array([[1.0, 2.0, 3.0], [1.0, np.nan, 2.0], [np.nan] * 3])
    energy, axes = whitened_energy(y, C)
    full = y[0] @ np.linalg.inv(C[0]) @ y[0]
    part = y[1, [0, 2]] @ np.linalg.inv(C[1][np.ix_([0, 2], [0, 2])]) @ y[1, [0, 2]]
    np.testing.assert_allclose(energy, [full, part, 0.0], rtol=1e-12)
    assert axes.tolist() == [3, 2, 0]
    C[2, 0, 0] = np.nan  # the covariance of a missing sensor is not used
    np.testing.assert_array_equal(whitened_energy(y, C)[0], energy)
    np.testing.assert_allclose(smallest_pivots(y, C), [0.75, 1.0, 1.0], rtol=1e-12)
    C[1, 0, 0] = -1.0
    with pytest.raises(np.linalg.LinAlgError, match='definite'):
        whitened_energy(y, C)
    with pytest.raises(ValueError, match='C: shape does not match'):
        whitened_energy(y, C[:2])


def test_the_smallest_pivot_identifies_invalid_covariances():
    """The pivot has the sign of the smallest eigenvalue, for any units of the axes."""
    rng, n = np.random.default_rng(3), 400
    std = 10.0 ** rng.uniform(-12.0, 3.0, (n, 3, 1))
    C = rng.uniform(-1.0, 1.0, (n, 3, 3))
    C = 0.5 * (C + np.swapaxes(C, 1, 2)) + np.eye(3)
    y = np.where(rng.random((n, 3)) < 0.2, np.nan, 1.0)
    present = ~np.isnan(y)
    present_part = np.where(present[:, :, None] & present[:, None, :], C, np.eye(3))
    is_valid = np.linalg.eigvalsh(present_part)[:, 0] > 0.0
    assert 0.1 < is_valid.mean() < 0.9
    C = C * std * np.swapaxes(std, 1, 2)
    np.testing.assert_array_equal(smallest_pivots(y, C) > 0.0, is_valid)
    # Two axes that are almost fully correlated.
    C = np.repeat(np.array([[4.0, 2.0 * (1.0 - 1e-6), 0.0], [0, 1.0, 0], [0, 0, 9.0]])[None], 4, 0)
    C[:, 1, 0] = C[:, 0, 1]
    for k, bad in enumerate((np.nan, np.inf)):
        C[1 + k, 0, 2] = bad
    C[3, 2, 2] = np.inf
    pivots = smallest_pivots(np.zeros((4, 3)), C)
    assert pivots[0] == pytest.approx(2e-6, rel=1e-5)
    assert np.isnan(pivots[1:]).all()


@pytest.mark.parametrize('invalid', [-SIGMA**2, np.nan, np.inf])
def test_a_frame_with_an_invalid_covariance_is_rejected_and_counted(invalid):
    network = line_network(2)
    stage = detector(network, onset_frames=1)
    strong = frame(0, np.full((2, 3), 10 * SIGMA), network)
    strong.covariance[1] = invalid
    assert stage.feed(strong) == []
    assert count_of(stage.counts, 'definite') == 1
    assert [type(r) for r in stage.feed(frame(1, strong.field, network))] == [Detection, FieldFrame]


def test_onset_needs_consecutive_frames_and_the_hold_bridges_gaps():
    network = line_network(2)
    stage = detector(network, onset_frames=3, hold_s=0.4)
    strong, quiet = np.full((2, 3), 10 * SIGMA), np.zeros((2, 3))
    pattern = ([quiet] * 3 + [strong] * 2 + [quiet] + [strong] * 4 + [quiet] * 3 + [strong]
               + [quiet] * 8)
    events, present = [], []
    for k, field in enumerate(pattern):
        for r in stage.feed(frame(k, field, network)):
            if isinstance(r, Detection):
                events.append((k, r.onset, r.id))
            else:
                present.append(r.target_present)
    # Three consecutive frames above the threshold are an onset, two are not; the hold time
    # bridges a short quiet interval.
    assert events == [(8, True, 1), (19, False, 1)]
    assert present == [8 <= k < 19 for k in range(len(pattern))]


def test_a_jump_back_in_time_ends_the_detection():
    network = line_network(2)
    stage = detector(network, onset_frames=1)
    stage.feed(frame(100, np.full((2, 3), 10 * SIGMA), network))
    records = stage.feed(frame(5, np.zeros((2, 3)), network))
    assert [r.onset for r in records if isinstance(r, Detection)] == [False]
    assert records[-1].target_present is False
    assert count_of(stage.counts, 'jumped') == 1
