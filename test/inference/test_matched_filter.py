"""Matched filter: Parseval's theorem, oracles in the time domain, and measured rates."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import binom, norm

from mag_tracking.inference.matched_filter import (
    any_detection_probability,
    deflection,
    detection_probability,
    noise_spectrum,
)

ALL = (0.0, np.inf)
MITRE_NOISE = {'background': 1e-10, 'resolution': 9e-10, 'bandwidth': 11.0}
"""Noise parameters of MITRE12 table 1."""


def mitre(f):
    """Noise density of MITRE12 [T^2/Hz]."""
    return noise_spectrum(f, **MITRE_NOISE)


def white(density):
    """Flat spectrum of a given density."""
    return lambda f: np.full(f.shape, density)


def within_binomial(hits, n, p):
    """Whether a count agrees with probability `p`, at a significance of 0.1 %."""
    low, high = binom.ppf([0.0005, 0.9995], n, p)
    return low <= hits <= high


def pulse(n, rate, rng=None):
    """Signal (n, 2) [T]: smooth, or random if `rng` is given."""
    t = np.arange(n) / rate
    if rng is not None:
        return 1e-9 * rng.standard_normal((n, 2))
    return 1e-9 * np.stack([np.exp(-60.0 * (t - 0.2)**2), t * np.cos(40.0 * t)], axis=-1)


def test_noise_spectrum_equals_the_published_one():
    """MITRE12 eq. (B.8) at 4 Hz in a town; the density of eq. (B.9) integrates to step^2/12."""
    # Not pytest.approx: its absolute tolerance of 1e-12 exceeds these values.
    np.testing.assert_allclose(noise_spectrum(4.0, 1e-10, 0.0, 11.0), 2.5e-21, rtol=1e-12)
    steps = noise_spectrum(np.array([0.0, 5.0]), 0.0, 9e-10, 11.0)
    np.testing.assert_allclose(steps * 2 * 11.0, (9e-10)**2 / 12, rtol=1e-12)
    f = np.array([[1.0, 7.0], [-3.0, 11.0]])
    expected = noise_spectrum(f, 1e-10, 0.0, 11.0) + noise_spectrum(f, 0.0, 9e-10, 11.0)
    np.testing.assert_allclose(mitre(f), expected, rtol=1e-12)
    np.testing.assert_array_equal(mitre(-f), mitre(f))
    assert mitre(0.0) == np.inf


@pytest.mark.parametrize('n', [11, 12, 1, 2])
def test_white_noise_gives_energy_over_noise_power(n):
    """The noise power of a sample is S times the rate, for odd and even numbers of samples."""
    rate, power = 22.0, (3e-10)**2
    B = pulse(n, rate, np.random.default_rng(n))
    expected = np.sqrt(np.sum(B**2) / power)
    assert deflection(B, rate, white(power / rate), ALL) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize('n, rate', [(11, 22.0), (24, 48.0)])
def test_coloured_noise_gives_the_deflection_of_the_time_domain(n, rate):
    """d^2 = s' C^+ s in the time domain, with the covariance C of the band-passed noise."""
    B, band = pulse(n, rate), (3.0, 11.0)
    k = np.arange(-(n // 2) + (n % 2 == 0), n // 2 + 1)
    f = k * rate / n
    S = np.where((np.abs(f) >= 3.0) & (np.abs(f) <= 11.0), mitre(np.where(k == 0, 1.0, f)), 0.0)
    lag = (np.arange(n)[:, None] - np.arange(n)) / rate
    C = rate / n * np.cos(2.0 * np.pi * f * lag[..., None]) @ S
    squares = [b @ np.linalg.pinv(C, rcond=1e-9, hermitian=True) @ b for b in B.T]
    expected = np.sqrt(np.sum(squares))
    assert deflection(B, rate, mitre, band) == pytest.approx(expected, rel=1e-8)


def test_a_long_smooth_signal_gives_the_deflection_of_the_integral():
    """The signal is a Gaussian pulse with known continuous transform, and the density is smooth."""
    width, size = 0.1, 2e-9
    t = np.arange(-400, 400) / 50.0
    B = size * np.exp(-0.5 * (t / width)**2)[:, None]

    def density(f):
        return 1e-20 * (1.0 + f**2)

    def integrand(f):
        transform = size * width * np.sqrt(2 * np.pi) * np.exp(-2 * (np.pi * f * width)**2)
        return transform**2 / density(f)

    expected = np.sqrt(2.0 * quad(integrand, 0.0, 12.0, epsabs=0.0)[0])
    assert deflection(B, 50.0, density, ALL) == pytest.approx(expected, rel=1e-10)


def test_sampling_rate_has_no_effect_on_a_band_limited_signal():
    """MITRE12 eq. (B.11) has a misprint: with the plain DFT, d would grow with the rate."""
    def deflection_at(rate):
        t = np.arange(round(0.5 * rate)) / rate
        B = 1e-9 * np.stack([np.cos(8 * np.pi * t) + 0.5 * np.sin(20 * np.pi * t + 0.3),
                             np.sin(12 * np.pi * t)], axis=-1)
        return deflection(B, rate, mitre, (3.0, 11.0))

    # Over half a second, a sine of amplitude a has energy a^2/4.
    S = mitre(np.array([4.0, 10.0, 6.0]))
    expected = 1e-9 * np.sqrt(np.sum(np.array([1.0, 0.25, 1.0]) / 4.0 / S))
    for rate in (22.0, 44.0, 90.0, 1000.0):
        assert deflection_at(rate) == pytest.approx(expected, rel=1e-10)


def test_band_includes_its_edges_and_excludes_other_frequencies():
    t = np.arange(11) / 22.0
    tone = 1e-9 * np.cos(2 * np.pi * np.outer(t, [4.0, 6.0, 8.0]))
    d = [deflection(tone[:, [i]], 22.0, mitre, (4.0, 6.0)) for i in range(3)]
    assert d[0] > 1.0 and d[1] > 1.0 and d[2] < 1e-9
    # 0.3/3 is below 0.1 by rounding.
    assert deflection([[1.0], [2.0], [4.0]], 0.3, white(1.0), (0.1, 1.0)) > 0.0
    # The constant Earth field does not count, although the noise density at 0 Hz is infinite.
    field = np.full((11, 2), 5e-5) + tone[:, :2]
    for band in (ALL, (3.0, 11.0)):
        assert deflection(field, 22.0, mitre, band) == pytest.approx(
            deflection(tone[:, :2], 22.0, mitre, band), rel=1e-6)


def test_squared_deflections_of_axes_add_and_missing_axes_are_ignored():
    B = np.random.default_rng(2).standard_normal((4, 3, 11, 2)) * 1e-9
    d = deflection(B, 22.0, mitre, (3.0, 11.0))
    assert d.shape == (4, 3)
    each = [deflection(B[..., [i]], 22.0, mitre, (3.0, 11.0)) for i in range(2)]
    np.testing.assert_allclose(d, np.hypot(*each), rtol=1e-12)
    B[0, 0, :, 1] = B[1, 1] = np.nan
    d = deflection(B, 22.0, mitre, (3.0, 11.0))
    assert d[0, 0] == pytest.approx(each[0][0, 0], rel=1e-12)
    p = detection_probability(d, 1e-6)
    assert np.argwhere(np.isnan(d)).tolist() == np.argwhere(np.isnan(p)).tolist() == [[1, 1]]
    assert any_detection_probability(p) == pytest.approx(1.0 - np.nanprod(1.0 - p), rel=1e-9)
    assert any_detection_probability([np.nan, np.nan]) == 0.0


def test_detection_probability_has_known_values_and_increases():
    p_fa = np.array([1e-12, 1e-6, 0.01, 0.5])
    np.testing.assert_allclose(detection_probability(0.0, p_fa), p_fa, rtol=1e-9)
    np.testing.assert_allclose(detection_probability(norm.isf(p_fa), p_fa), 0.5, rtol=1e-12)
    d = np.linspace(0.0, 12.0, 50)
    p = detection_probability(d[:, None], p_fa[:3])
    assert p.shape == (50, 3) and np.all(np.diff(p[d < 6.0], axis=0) > 0.0)
    assert np.all(np.diff(p, axis=1) >= 0.0) and detection_probability(np.inf, 1e-6) == 1.0
    # MITRE12 section 5.1: 59.3 % at a false-alarm probability of 1e-6.
    assert detection_probability(norm.isf(1e-6) - norm.isf(0.593), 1e-6) == pytest.approx(0.593)


def test_measured_rate_in_white_noise_agrees_with_theory():
    """The statistic is s'y / (sigma |s|), of noise with and without the signal s."""
    rng, n, sigma, rate = np.random.default_rng(7), 40_000, 4e-10, 22.0
    s = pulse(11, rate)
    noise = sigma * rng.standard_normal((n, 11, 2))
    for p_fa in (0.01, 0.2):
        for size in (0.0, 0.2, 0.4):
            d = deflection(size * s, rate, white(sigma**2 / rate), ALL)
            statistic = np.einsum('ta,nta->n', s, noise + size * s) / (
                sigma * np.sqrt(np.sum(s**2)))
            hits, p = np.sum(statistic > norm.isf(p_fa)), detection_probability(d, p_fa)
            print(f'P_FA {p_fa}, d {d:.2f}: {hits / n:.4f}, theory {p:.4f}')
            assert within_binomial(hits, n, p)
            assert size == 0.0 or p_fa * 1.2 < p < 0.97


def test_measured_rate_in_the_published_noise_agrees_with_theory():
    """The noise is a sum of tones of power 2 S df; the filter works in the frequency domain."""
    rng, n, rate, n_t = np.random.default_rng(8), 20_000, 22.0, 11
    s, f = 3.0 * pulse(n_t, rate)[:, 0], np.array([4.0, 6.0, 8.0, 10.0])
    t, df = np.arange(n_t) / rate, rate / n_t
    tones = np.concatenate([np.cos(2 * np.pi * f[:, None] * t), np.sin(2 * np.pi * f[:, None] * t)])
    power = np.tile(2.0 * mitre(f) * df, 2)
    amplitudes = np.sqrt(power) * rng.standard_normal((n, 8))
    y = s + amplitudes @ tones + 5e-5
    # Least squares for the tones of each record, weighted by their power.
    weight = (tones @ s) * (2.0 / n_t) / power
    statistic = (y @ tones.T) * (2.0 / n_t) @ weight / np.sqrt(np.sum(weight**2 * power))
    d = deflection(s[:, None], rate, mitre, (3.0, 11.0))
    hits, p = np.sum(statistic > norm.isf(0.05)), detection_probability(d, 0.05)
    print(f'd {d:.2f}: {hits / n:.4f}, theory {p:.4f}')
    assert within_binomial(hits, n, p) and 0.1 < p < 0.95


def test_any_detection_probability_is_one_minus_the_product():
    p = np.random.default_rng(3).uniform(0.0, 1.0, (3, 4, 5))
    for axis in (None, 0, -1, (1, 2)):
        np.testing.assert_allclose(any_detection_probability(p, axis),
                                   1.0 - np.prod(1.0 - p, axis=axis), rtol=1e-12)
    assert (any_detection_probability([0.3, 1.0, 0.0]) == 1.0
            and any_detection_probability([0.0, 0.0]) == 0.0)
    assert any_detection_probability(0.25) == pytest.approx(0.25, rel=1e-15)
    # No loss of precision: 1 - (1 - 1e-30)^3 is 0 in plain arithmetic.
    np.testing.assert_allclose(any_detection_probability([1e-30] * 3), 3e-30, rtol=1e-12)
    np.testing.assert_allclose(any_detection_probability(np.full(1000, 1e-17)), 1e-14, rtol=1e-9)


def test_measured_rate_of_a_network_agrees_with_theory():
    rng, n = np.random.default_rng(5), 20_000
    p = np.array([[0.01, 0.2, 0.05], [0.1, 0.02, 0.0]])
    hits = np.sum((rng.uniform(size=(n, 2, 3)) < p).any(axis=(1, 2)))
    assert within_binomial(hits, n, any_detection_probability(p))


GOOD = np.ones((11, 2))


@pytest.mark.parametrize('call, message', [
    (lambda: noise_spectrum([1.0, np.nan], 1e-10, 0.0, 11.0), r'frequency\[1\].*a number, got nan'),
    (lambda: noise_spectrum(1.0, -1e-10, 0.0, 11.0), 'background.*at least 0.*got -1e-10'),
    (lambda: noise_spectrum(1.0, 1e-10, np.inf, 11.0), 'resolution.*got inf'),
    (lambda: noise_spectrum(1.0, 1e-10, 0.0, 0.0), 'bandwidth.*above 0.*got 0.0'),
    (lambda: deflection(GOOD[:, 0], 22.0, mitre, ALL), r'B .*\(11,\)'),
    (lambda: deflection(GOOD[:0], 22.0, mitre, ALL), r'B .*\(0, 2\)'),
    (lambda: deflection(np.where(np.arange(11)[:, None] == 3, np.nan, GOOD), 22.0, mitre, ALL),
     r'B\[3, 0\].*nan'),
    (lambda: deflection(GOOD * np.inf, 22.0, mitre, ALL), r'B\[0, 0\].*got inf'),
    (lambda: deflection(GOOD, -22.0, mitre, ALL), 'sampling_rate.*got -22.0'),
    (lambda: deflection(GOOD, 22.0, mitre, (5.0, 3.0)), r'band.*ascending.*got \[5.0, 3.0\]'),
    (lambda: deflection(GOOD, 22.0, mitre, (-1.0, 3.0)), r'band.*got \[-1.0, 3.0\]'),
    (lambda: deflection(GOOD, 22.0, mitre, (4.5, 5.5)), '11 samples .*22.0 Hz'),
    (lambda: deflection(GOOD, 22.0, white(0.0), ALL), r'spectrum\[0\].*above 0, got 0.0'),
    (lambda: deflection(GOOD, 22.0, white(np.nan), ALL), r'spectrum\[0\].*got nan'),
    (lambda: detection_probability([1.0, -0.5], 0.1), r'deflection\[1\].*at least 0, got -0.5'),
    (lambda: detection_probability(1.0, 0.0), 'false_alarm_probability.*got 0.0'),
    (lambda: detection_probability(1.0, [0.5, np.nan]), r'false_alarm_probability\[1\].*got nan'),
    (lambda: any_detection_probability([0.5, 1.5]), r'probability\[1\].*from 0 to 1, got 1.5'),
    (lambda: any_detection_probability(-0.1), 'probability.*got -0.1'),
])
def test_invalid_arguments_raise_value_error(call, message):
    with pytest.raises(ValueError, match=message):
        call()
