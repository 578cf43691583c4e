"""Hard and soft iron from the readings of a tumbled sensor."""

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.stats import binom, special_ortho_group, t

from mag_tracking.calibration import ellipsoid
from mag_tracking.calibration.ellipsoid import N_BLOCKS
from mag_tracking.calibration.ellipsoid_fit import fit_ellipsoid
from support.bundled import DATA
from support.marks import studied

CORRECTION = np.array([[1.1, 0.05, -0.02], [0.05, 0.9, 0.03], [-0.02, 0.03, 1.05]])
CORRECTION /= np.cbrt(np.linalg.det(CORRECTION))
OFFSET = np.array([0.3, -0.2, 0.5])
PERIOD = 618


def tumbling(n):
    """Unit vectors (n, 3) on a smooth curve that covers the sphere."""
    k = np.arange(n)
    z = 0.98 * np.cos(2.0 * np.pi * k / PERIOD * 1.236)
    rho, angle = np.sqrt(1.0 - z * z), 2.0 * np.pi * k / PERIOD * 13.0
    return np.stack([rho * np.cos(angle), rho * np.sin(angle), z], axis=1)


def scattered(n, seed=0):
    """Random unit vectors (n, 3)."""
    u = np.random.default_rng(seed).standard_normal((n, 3))
    return u / np.linalg.norm(u, axis=1)[:, None]


def readings(u, noise=0.01, seed=1, correction=CORRECTION, offset=OFFSET):
    """Readings (n, 3) of a field of magnitude one in the directions `u`."""
    field = u + noise * np.random.default_rng(seed).standard_normal(u.shape)
    return offset + np.linalg.solve(correction, field.T).T


def recording(name, skip):
    return np.loadtxt(DATA / 'calibration' / name, delimiter=',', skiprows=skip)[:, -3:]


def spread(values):
    sizes = np.linalg.norm(values, axis=1)
    return sizes.std() / sizes.mean()


@pytest.fixture(scope='module')
def recordings():
    return {'tumbled': recording('tumbled_acc_mag.csv', 1),
            'counts': recording('qmc5883l_raw_counts.csv.gz', 3)}


RECORDINGS = [('tumbled', 0.015, 0.31951, [0.148, 0.389, -0.059], 5e-4),
              ('counts', 0.03, 0.09519, [6195.0, 250.0, 3480.0], 0.5)]
"""Name, maximum residual, residual before correction, offset from another program, and half a unit
of the last digit of that offset."""


@pytest.mark.parametrize('name, limit, before, offset, digit', RECORDINGS)
def test_fits_of_recordings_agree_with_another_program(recordings, name, limit, before, offset,
                                                       digit):
    y = recordings[name]
    fit = fit_ellipsoid(y)
    print(f'{name}: {fit.residual_before:.5f} to {fit.residual:.5f}, offset {fit.offset} '
          f'+- {fit.offset_std}, radius {fit.field_magnitude:.6g}, coverage {fit.coverage:.3f}')
    assert fit.converged and fit.reason == '' and fit.warnings == ()
    assert fit.n_readings == len(y) and fit.n_outliers < 0.001 * len(y)
    assert fit.residual_before == pytest.approx(before, abs=1e-5)
    assert fit.residual == pytest.approx(spread(fit.correct(y)), rel=1e-12)
    assert fit.residual <= limit
    assert (np.abs(fit.offset - offset) < 3.0 * fit.offset_std + digit).all()
    assert np.linalg.det(fit.correction) == pytest.approx(1.0, rel=1e-9)
    sizes = np.linalg.norm(fit.correct(y), axis=1)
    assert abs(sizes.mean() / fit.field_magnitude - 1.0) < 0.2 * limit


@pytest.mark.parametrize('name, limit', [(r[0], r[1]) for r in RECORDINGS])
def test_a_fit_of_half_a_recording_corrects_the_other_half(recordings, name, limit):
    y = recordings[name]
    fits = [fit_ellipsoid(y[k::2], field_magnitude=1.0) for k in (0, 1)]
    for fit, other_half in zip(fits, (y[1::2], y[::2]), strict=True):
        assert spread(fit.correct(other_half)) <= limit
    # Adjacent readings share errors, so the two fits differ by less than their errors.
    assert (np.abs(fits[0].offset - fits[1].offset) < 3.0 * fits[0].offset_std).all()


def test_a_recording_of_a_sensor_at_rest_is_rejected(recordings):
    fit = fit_ellipsoid(recordings['counts'][:3000])
    assert not fit.converged and 'at rest' in fit.reason


@settings(derandomize=True, deadline=None, max_examples=25)
@given(st.integers(0, 10**6), st.floats(-9.0, 5.0))
def test_exact_readings_give_exact_parameters(seed, decade):
    rng = np.random.default_rng(seed)
    V = special_ortho_group.rvs(3, random_state=rng)
    true = (V * rng.uniform(0.6, 1.6, 3)) @ V.T
    true /= np.cbrt(np.linalg.det(true))
    offset, unit = 3.0 * rng.standard_normal(3), 10.0**decade
    fit = fit_ellipsoid(unit * readings(tumbling(700), 0.0, correction=true, offset=offset))
    assert fit.converged and fit.warnings == ()
    np.testing.assert_allclose(fit.offset, unit * offset, atol=1e-9 * unit)
    np.testing.assert_allclose(fit.correction, true, atol=1e-9)
    assert fit.field_magnitude == pytest.approx(unit, rel=1e-9)
    assert fit.residual < 1e-9 and fit.coverage > 0.5


@pytest.mark.parametrize('unit', [1e-9, 3e-5, 2e4])
@pytest.mark.parametrize('size', [None, 5e-5])
def test_units_only_scale_the_result(unit, size):
    y = readings(tumbling(1000))
    one, other = fit_ellipsoid(y, size), fit_ellipsoid(unit * y, size)
    scale = unit if size is None else 1.0
    for a, b in [(one.offset * unit, other.offset), (one.offset_std * unit, other.offset_std),
                 (one.correction * scale, other.correction * unit),
                 (one.correction_std * scale, other.correction_std * unit),
                 (one.field_magnitude * scale, other.field_magnitude),
                 (one.field_magnitude_std * scale, other.field_magnitude_std),
                 (one.residual, other.residual), (one.coverage, other.coverage)]:
        np.testing.assert_allclose(b, a, rtol=1e-5)


def test_corrected_field_has_the_given_magnitude():
    y = readings(tumbling(1000))
    free, fit = fit_ellipsoid(y), fit_ellipsoid(y, 5e-5)
    assert fit.field_magnitude == 5e-5 and fit.field_magnitude_std == 0.0
    assert free.field_magnitude_std > 0.0
    assert np.linalg.norm(fit.correct(y), axis=1).mean() == pytest.approx(5e-5, rel=0.002)
    np.testing.assert_allclose(fit.correction * free.field_magnitude, 5e-5 * free.correction,
                               rtol=1e-9)
    assert np.array_equal(fit.offset, free.offset)


def test_rotated_and_shifted_readings_rotate_and_shift_the_fit():
    y = readings(tumbling(3000))
    one = fit_ellipsoid(y)
    for seed in range(4):
        R = special_ortho_group.rvs(3, random_state=seed)
        shift = np.array([5.0, -3.0, 2.0])
        other = fit_ellipsoid(y @ R.T + shift)
        # The cells do not rotate with the readings, so the weights change slightly.
        assert np.abs(R.T @ (other.offset - shift) - one.offset).max() \
            < 0.3 * one.offset_std.max()
        assert np.abs(R.T @ other.correction @ R - one.correction).max() \
            < 0.3 * one.correction_std.max()
        assert other.coverage == pytest.approx(one.coverage, abs=0.05)


def test_fit_equals_the_optimum_of_a_general_solver():
    """The oracle minimises the soft L1 loss with a numerical Jacobian and unit weights."""
    y = readings(scattered(2000), 0.03)
    y[::30] = OFFSET + 1.3 * (y[::30] - OFFSET)
    rows, columns = np.triu_indices(3)

    def residual(theta):
        C = np.zeros((3, 3))
        C[rows, columns] = C[columns, rows] = theta[3:]
        return np.linalg.norm((y - theta[:3]) @ C, axis=1) - 1.0

    theta = np.concatenate([OFFSET, CORRECTION[rows, columns]])
    for _ in range(3):
        scale = 2.0 * 1.4826 * np.median(np.abs(residual(theta)))
        theta = least_squares(residual, theta, loss='soft_l1', f_scale=scale, xtol=1e-12).x
    fit = fit_ellipsoid(y, 1.0)
    assert (np.abs(fit.offset - theta[:3]) < 0.02 * fit.offset_std).all()
    assert (np.abs(fit.correction[rows, columns] - theta[3:])
            < 0.02 * fit.correction_std[rows, columns]).all()


@pytest.mark.parametrize('correlation', studied([0.0, 0.8], [0.0]))
def test_stated_stds_cover_the_truth(correlation):
    """80 % intervals have their nominal coverage, also for noise that is correlated in time.

    The noise is small, because the square of the noise biases the radius.
    """
    n_runs, n, rng = 150, 1500, np.random.default_rng(3)
    u, errors = tumbling(n), []
    for _ in range(n_runs):
        e = 0.003 * rng.standard_normal((n, 3))
        for k in range(1, n if correlation else 0):
            e[k] = correlation * e[k - 1] + np.sqrt(1.0 - correlation**2) * e[k]
        fit = fit_ellipsoid(readings(u + e, 0.0))
        errors.append(np.concatenate([
            (fit.offset - OFFSET) / fit.offset_std,
            ((fit.correction - CORRECTION) / fit.correction_std)[np.triu_indices(3)],
            [(fit.field_magnitude - 1.0) / fit.field_magnitude_std]]))
    inside = np.abs(errors) < t.ppf(0.9, N_BLOCKS - 1)
    rates = inside.mean(axis=0)
    print(f'{correlation}: {rates.round(3)}')
    low, high = binom.ppf([5e-4, 1.0 - 5e-4], n_runs, 0.8)
    assert (low <= inside.sum(axis=0)).all() and (inside.sum(axis=0) <= high).all()


def test_a_varying_field_magnitude_does_not_affect_the_std_of_the_shape():
    """Each time block covers the sphere with its own field magnitude; det(correction) is one."""
    size = 1.0 + 0.02 * np.random.default_rng(6).standard_normal(N_BLOCKS)
    fit = fit_ellipsoid(readings(tumbling(20000) * np.repeat(size, 20000 // N_BLOCKS)[:, None]))
    assert fit.field_magnitude_std == pytest.approx(0.02 / np.sqrt(N_BLOCKS), rel=0.4)
    assert np.diagonal(fit.correction_std).max() < 0.5 * fit.field_magnitude_std


def test_readings_at_rest_weigh_no_more_than_one_direction():
    """The field is distorted by 3 % in a pattern that no ellipsoid describes."""
    u = tumbling(2000)
    x, y, z = u.T
    distorted = readings(u * (1.0 + 0.03 * (5.0 * z**3 - 3.0 * z) / 2.0)[:, None], 0.002)
    at_rest = readings(np.tile([0.0, 0.0, 1.03], (6000, 1)), 0.002, seed=5)
    expected, fit = (fit_ellipsoid(distorted),
                     fit_ellipsoid(np.concatenate([at_rest, distorted])))
    assert fit.converged
    # The readings at rest, three quarters of all readings, have the weight of 3 of 500 cells.
    assert np.abs(fit.offset - expected.offset).max() < 0.001


@pytest.mark.parametrize('factor', [1.3, 0.5, 2.2])
def test_outliers_are_bounded_and_counted(factor):
    y = readings(scattered(2000))
    clean = fit_ellipsoid(y)
    y[::25] = OFFSET + factor * (y[::25] - OFFSET)
    fit = fit_ellipsoid(y)
    assert fit.converged and fit.n_outliers == 80 and fit.n_readings == 2000
    assert 'outliers is 0.04' in fit.warnings[-1]
    assert (np.abs(fit.offset - OFFSET) < 4.0 * fit.offset_std).all()
    assert (fit.offset_std < 1.5 * clean.offset_std).all()
    assert fit.residual == pytest.approx(spread(fit.correct(y)), rel=1e-12)


def test_glitches_are_excluded_and_counted():
    y = readings(tumbling(2000))
    clean = fit_ellipsoid(y)
    y[::100] = np.array([32767.0, -32768.0, 40.0]) * np.linspace(0.9, 1.0, 20)[:, None]
    fit = fit_ellipsoid(y)
    assert fit.converged and fit.n_outliers == 20 and fit.n_readings == 1980
    assert (np.abs(fit.offset - clean.offset) < clean.offset_std).all()
    # The residual includes all readings.
    assert fit.residual > 1.0 and any('residual' in w for w in fit.warnings)


def test_missing_readings_are_excluded_and_counted():
    y = readings(tumbling(1000))
    gaps = np.insert(y, range(0, 1000, 10), y[::10] * [np.nan, 1.0, 1.0], axis=0)
    fit, expected = fit_ellipsoid(gaps), fit_ellipsoid(y)
    assert fit.n_missing == 100 and fit.n_readings == 1000 and fit.converged
    (warning,) = fit.warnings
    assert warning.endswith('missing axis: 100')
    np.testing.assert_array_equal(fit.offset, expected.offset)
    assert fit.residual == expected.residual and fit.residual_before == expected.residual_before


def test_marks_for_missing_readings_are_excluded_and_named():
    y = readings(tumbling(2000))
    marked = y.copy()
    marked[::50] = -32768.0
    fit = fit_ellipsoid(marked)
    expected = fit_ellipsoid(np.delete(y, slice(None, None, 50), axis=0))
    assert fit.converged and fit.n_missing == 40 and '-32768' in fit.warnings[0]
    np.testing.assert_array_equal(fit.offset, expected.offset)


def test_saturated_readings_are_excluded_and_reported():
    y = readings(tumbling(20000))
    limit = 0.5 * (OFFSET[1] + y[:, 1].max())
    y[:, 1] = np.minimum(y[:, 1], limit)
    y[::50, 0] = np.nan
    fit = fit_ellipsoid(y)
    assert fit.n_readings + fit.n_missing + fit.n_saturated == 20000 and fit.n_missing == 400
    assert fit.converged and fit.n_saturated > (y[:, 1] == limit).sum() > 1000
    assert fit.warnings[1].endswith(f' y: {fit.n_saturated}')
    assert (np.abs(fit.offset - OFFSET) < 4.0 * fit.offset_std).all()
    assert fit.residual == pytest.approx(spread(fit.correct(y[~np.isnan(y[:, 0])])), rel=1e-12)


def ball(n):
    """Vectors (n, 3) that fill a ball."""
    return scattered(n) * np.cbrt(np.random.default_rng(9).uniform(size=n))[:, None]


U = scattered(3000)
EVEN = tumbling(1500)
RING = np.stack([np.cos(0.1 * np.arange(600)), np.sin(0.1 * np.arange(600)), np.zeros(600)], 1)
POSES = np.repeat(scattered(16, seed=2), 100, axis=0)
LONG = np.diag([1.0, 1.0, 8.0])


@pytest.mark.parametrize('y, reason', [
    (np.zeros((0, 3)), '^0 valid readings, minimum 50'),
    (readings(EVEN[:49]), '^49 valid readings, minimum 50'),
    (np.full((100, 3), np.nan), '^0 valid readings, minimum 50'),
    (np.zeros((100, 3)), '100 .*equal'),
    (readings(np.tile(EVEN[0], (900, 1))), 'at rest'),
    (readings(RING, 0.0), 'plane: .* 0.05'),
    (readings(RING), 'plane: .* 0.05'),
    (readings(0.9 * RING + [0.0, 0.0, np.sqrt(0.19)]),
     'plane: .* 0.05'),
    (readings(U[np.abs(U[:, 2]) < 0.3]), r'coverage is 0.00.*0.01; .*: none'),
    (readings(U[U[:, 2] > 0.0]),
     r'coverage is 0.00.*0.01; .*: \+x\+y-z, \+x-y-z, -x\+y-z, -x-y-z$'),
    (readings(U[U[:, 0] < 0.0], 0.0), 'coverage is 0.00.*0.01'),
    (readings(U[U @ [0.6, 0.0, 0.8] > 0.6], 0.0), 'coverage is .*e-05.*0.01'),
    (readings(U[U @ [0.6, 0.0, 0.8] > 0.6]),
     'directions|factor|ellips'),
    (readings(EVEN, correction=LONG), 'ratio of 0.73 to 5.8, maximum 1 to 5'),
    (readings(U) * np.where(np.arange(3000) % 12 == 0, 3.0, 1.0)[:, None],
     'scatter .*0.1'),
    (readings(ball(3000)), 'scatter .*0.1'),
    (readings(POSES, 1e-4), '^readings in 15 directions, minimum 18'),
    (readings(EVEN) * np.where(np.arange(1500) % 25 == 0, 100.0, 1.0)[:, None],
     'outliers is 0.96.*0.2')])
def test_readings_that_cannot_be_fitted_are_rejected(y, reason):
    fit = fit_ellipsoid(y)
    print(fit.reason)
    assert not fit.converged and re.search(reason, fit.reason)


@pytest.mark.parametrize('seed', range(40))
def test_an_accepted_fit_is_near_the_truth(seed):
    """The directions cover random parts of the sphere; the readings are few or noisy."""
    rng = np.random.default_rng(seed)
    u = scattered(1200, seed)
    along = u @ scattered(1, seed + 1000)[0]
    part = np.abs(along) < rng.uniform() if seed % 2 else along > rng.uniform(-1.0, 0.9)
    u = u[part][:rng.choice([80, 300])]
    fit = fit_ellipsoid(readings(u, rng.choice([0.003, 0.01, 0.03]), seed))
    assert bool(fit.reason) != fit.converged
    if fit.converged:
        assert (np.abs(fit.offset - OFFSET) < 6.0 * fit.offset_std).all()
        assert np.linalg.norm(fit.offset - OFFSET) < 0.1


def test_an_uncertain_offset_is_rejected():
    fit = fit_ellipsoid(readings(U[U[:, 2] > -0.3][:60], 0.06, seed=4))
    print(fit.reason)
    assert not fit.converged and 'offset is 0.' in fit.reason


def test_least_squares_without_convergence_are_rejected(monkeypatch):
    solve = ellipsoid.least_squares
    monkeypatch.setattr(ellipsoid, 'least_squares',
                        lambda *a, **k: solve(*a, **(k | {'max_nfev': 1})))
    fit = fit_ellipsoid(readings(EVEN))
    assert not fit.converged and 'converge' in fit.reason


@pytest.mark.parametrize('y, warning', [
    (readings(U[np.abs(U[:, 2]) < 0.5]), 'coverage is 0.0.*0.1'),
    (readings(U[(U < 0.0).any(axis=1)]), r'octants .*: \+x\+y\+z$'),
    (readings(EVEN, 0.08), 'residual .*0.0.*0.05')])
def test_readings_of_poor_quality_raise_a_warning(y, warning):
    fit = fit_ellipsoid(y)
    assert fit.converged and len(fit.warnings) == 1 and re.search(warning, fit.warnings[0])


def test_coverage_equals_the_known_values():
    """The known values are integrals of harmonics up to degree two over part of a sphere."""
    u = scattered(60000)
    for min_x, known in [(-1.0, 1.0), (-0.5, 0.10852), (0.0, 0.0078433)]:
        fit = fit_ellipsoid(readings(u[u[:, 0] > min_x], 0.0))
        assert fit.coverage == pytest.approx(known, rel=0.25)


@pytest.mark.parametrize('y, size, message', [
    (np.zeros((5, 2)), None, r'readings .*\(5, 2\)'),
    (np.zeros(3), None, r'readings .*\(3,\)'),
    (np.where(np.arange(1500)[:, None] == 7, -np.inf, EVEN), None, 'reading 7 is infinite'),
    (EVEN, 0.0, 'field_magnitude .*0.0'),
    (EVEN, -1.0, 'field_magnitude .*-1.0'),
    (EVEN, np.nan, 'field_magnitude .*nan'),
    (EVEN, np.inf, 'field_magnitude .*inf')])
def test_invalid_arguments_raise_value_error(y, size, message):
    with pytest.raises(ValueError, match=message):
        fit_ellipsoid(y, size)
