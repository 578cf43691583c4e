"""Examples that reproduce published figures: they run, and their numbers are verified."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2, ncx2, norm

from mag_tracking.physics.dipole import dipole_field

EXAMPLES = Path(__file__).resolve().parents[2] / 'examples'
PNG_SIGNATURE = b'\x89PNG\r\n\x1a\n'


def example(name):
    """Import a script as a module; examples/ is not a package."""
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f'{name}.py')
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope='module')
def mitre12():
    return example('mitre12')


@pytest.fixture(scope='module')
def t10():
    return example('t10_observability')


@pytest.fixture(scope='module')
def detection_results(mitre12):
    return mitre12.compare_detection()


@pytest.fixture(scope='module')
def bound_results(mitre12):
    return mitre12.compare_bounds()


@pytest.fixture(scope='module')
def observability_results(t10):
    return t10.comparison(t10.condition_maps())


@pytest.mark.parametrize('name, figures, expected', [
    ('mitre12', '23456', ['100 pT/sqrt(Hz)', 'DFT divided by N', '62.6%, published 59.3 %',
                          '91.5%, published 90 %', 'x0, y0, v, M1, M2 have none']),
    ('t10_observability', '234', ['0, 0.2305 are', '0, 0, 0.7141', 'at [0, 2] is 2571',
                                  'truck 17.3 m']),
])
def test_an_example_draws_figures_and_prints_differences(name, figures, expected, tmp_path, capsys):
    module, out = example(name), tmp_path / 'a' / 'b'
    module.main(['--out', str(out)])
    stem = 'figure_5_' if name.startswith('t10') else 'figure_'
    assert {p.name for p in out.iterdir()} == {f'{stem}{i}.png' for i in figures}
    assert all(p.read_bytes().startswith(PNG_SIGNATURE) and p.stat().st_size > 10_000
               for p in out.iterdir())
    printed = capsys.readouterr().out
    for words in expected:
        assert words in printed
    assert 'agrees' in printed and 'differs' in printed and 'nan' not in printed


def test_the_moment_and_field_of_the_car_match_the_equations(mitre12):
    """MITRE12 (A.1)-(A.6), (1) and (2), written out for a car that drives north or east."""
    L1, dip, declination = 0.17356, np.radians(59.0), np.radians(-11.0)
    H = 57e-6 / (4e-7 * np.pi) * np.cos(dip)
    volume = 4.0 / 3.0 * np.pi * 2.0
    along, across = (volume * 10.0 / (1.0 + 10.0 * L) for L in (L1, 0.5 * (1.0 - L1)))
    sin, cos = H * np.sin(declination), H * np.cos(declination)
    # Left of north is west, left of east is north.
    east = mitre12.moment('car', np.pi / 2)
    np.testing.assert_allclose(east[:2], [along * sin, across * cos], rtol=1e-4)
    m = mitre12.moment('car')
    m1, m2 = along * cos, -across * sin
    np.testing.assert_allclose(m[:2], [m1, m2], rtol=1e-4)
    assert m[2] < 0.0  # the Earth's field points down in the north
    x, y = -7.0, 25.0
    R = np.hypot(x, y)
    B = 1e-7 / R**5 * np.array([m1 * (3 * x**2 - R**2) + 3 * m2 * x * y,
                                m2 * (3 * y**2 - R**2) + 3 * m1 * x * y])
    np.testing.assert_allclose(dipole_field(-np.array([x, y, 0.0]), m)[:2], B, rtol=1e-4)


def test_positions_follow_the_published_equations_of_motion(mitre12):
    theta, k = 0.4, np.arange(11)
    r = mitre12.source_positions(3.0, -2.0, 10.0, theta)
    np.testing.assert_allclose(r[:, 0], 3.0 - k / 22.0 * 10.0 * np.sin(theta), rtol=1e-12)
    np.testing.assert_allclose(r[:, 1], -2.0 + k / 22.0 * 10.0 * np.cos(theta), rtol=1e-12)
    # The direction along x is -90 degrees in the paper.
    assert mitre12.source_positions(0.0, 25.0, 10.0, mitre12.ROAD_HEADING)[-1, 0] \
        == pytest.approx(10.0 * 10 / 22)


@pytest.mark.parametrize('z', [[-20.0, 25.0, 11.0, -np.pi / 2, -137.0, 374.0],
                               [4.0, 9.0, -6.0, 0.7, 250.0, 100.0]])
def test_the_jacobian_matches_finite_differences_of_the_field(mitre12, z):
    def field(z):
        m = np.array([z[4], z[5], 0.0])
        return dipole_field(-mitre12.source_positions(*z[:4]), m)[:, :2]

    step = 1e-4 * np.array([1.0, 1.0, 1.0, 1.0, 100.0, 100.0])
    numeric = np.stack([(field(z + e) - field(z - e)) / (2.0 * e.max()) for e in np.diag(step)],
                       axis=-1)
    analytic = mitre12.jacobian(z)
    magnitude = np.abs(numeric).max(axis=(0, 1))
    np.testing.assert_allclose(analytic / magnitude, numeric / magnitude, atol=1e-6)


@pytest.mark.parametrize('divisor, scale, cpa', [(11.0, {}, 29.0), (22.0, {'scale': 1.0}, 25.0)])
def test_the_detection_probability_matches_explicit_sums(mitre12, divisor, scale, cpa):
    """MITRE12 (B.8)-(B.13), summed over four frequencies, with the DFT divided by N or by F_s."""
    k, t = np.arange(11), np.arange(11) / 22.0
    r = np.stack([-3.0 + 25.0 * 0.44704 * t, np.full(11, cpa), np.zeros(11)], axis=-1)
    B = dipole_field(-r, mitre12.moment('car'))[:, :2]
    square = 0.0
    for line in (2, 3, 4, 5):
        f = 2.0 * line
        S = (100e-12)**2 / f + (9e-10)**2 / (24.0 * 11.0)
        transform = np.exp(-2j * np.pi * line * k / 11.0) @ B / divisor
        square += 2.0 * 2.0 * np.sum(np.abs(transform)**2) / S
    expected = norm.sf(norm.isf(1e-6) - np.sqrt(square))
    p = mitre12.detection(mitre12.moment('car'), cpa, np.array([-3.0]), mitre12.ONE_SENSOR, **scale)
    assert p[0, 0] == pytest.approx(expected, rel=1e-9) and 0.3 < expected < 0.95


def test_detection_probabilities_are_near_the_published_ones(mitre12, detection_results):
    """The differences from 59.3 % and 90 % are 3.3 and 1.5 percentage points."""
    n = detection_results
    # The aim is the published numbers. Tolerances are the printed differences, rounded up.
    assert n['most'] == pytest.approx(0.593, abs=0.034)
    assert n['once'] == pytest.approx(0.900, abs=0.016)
    # MITRE12: "nearly one", "almost always", "almost always fails", "a high probability",
    # "nontrivial".
    assert n['five'] > 0.999 and n['at 25'] > 0.999 and n['at 35'] < 0.1
    assert n['ATV at 10'] > 0.999 and n['ATV five most'] > 0.2
    # Neither the physical transform nor a road to the east reproduces the published numbers.
    assert n['once physical'] < n['once east'] < 0.2
    assert n['range physical'] < n['range east'] < n['range']
    # The probability falls with the CPA distance and grows with the number of sensors.
    for vehicle in ('car', 'ATV'):
        m = mitre12.moment(vehicle)
        once = np.array([[mitre12.drive_detection(m, c, s)
                          for s in (mitre12.ONE_SENSOR, mitre12.FIVE_SENSORS)]
                         for c in range(5, 45)])
        assert np.all(np.diff(once, axis=0) <= 1e-9) and np.all(once[:, 1] >= once[:, 0])


def test_bounds_of_one_sensor_without_a_prior_are_infinite(mitre12, bound_results):
    """The scale is unobservable with one sensor, so only theta has a bound without a prior."""
    n = bound_results
    assert n['lost'] == ('x0', 'y0', 'v', 'M1', 'M2')
    m = mitre12.moment('car')
    lost = np.array([-20.0, 25.0, mitre12.SPEED, 0.0, 3 * m[0], 3 * m[1]]) / 25.0
    np.testing.assert_allclose(n['kernel'], lost, rtol=1e-6, atol=1e-6)
    prior = [30.0, 5.0, 10.0, 15.0, 100.0, 100.0]
    assert np.all(n['with prior'] <= np.array(prior) * (1.0 + 1e-9))
    assert np.all(n['with prior'].min(axis=0)[:4] < 0.55 * np.array(prior[:4]))
    assert np.isinf(n['at 0 mph'][0][3])
    assert n['at 0 mph'][1][3] == pytest.approx(15.0, rel=1e-9)
    assert n['at 10 mph'][0][3] > n['at 25 mph'][0][3] > n['at 80 mph'][0][3]
    # With two sensors, the scale is observable.
    J = mitre12.period_information(-20.0) + mitre12.period_information(0.0)
    assert np.all(np.isfinite(mitre12.std_bounds(J)))


def test_printed_jacobian_and_prior_do_not_explain_the_published_bounds(mitre12, bound_results):
    """Equation (20) affects only phi. With four priors of (26), bounds are finite at zero speed."""
    x, y, h = -20.0, 25.0, 1e-5
    phi = np.array([np.arctan2(y, x + h) - np.arctan2(y, x - h),
                    np.arctan2(y + h, x) - np.arctan2(y - h, x)]) / (2.0 * h)
    C = mitre12.bound(mitre12.period_information(x), mitre12.PRIOR)[:2, :2]
    printed, right = bound_results['phi at -20 m']
    assert right == pytest.approx(np.degrees(np.sqrt(phi @ C @ phi)), rel=1e-6)
    assert printed < 0.8 * right
    assert np.all(np.isfinite(bound_results['at 0 mph'][2]))
    assert np.all(bound_results['prior on four'][:, :4] <= np.array([30.0, 5.0, 10.0, 15.0]) + 1e-9)
    assert np.all(bound_results['prior on four'][:, 4:].max(axis=0) > 500.0)


def test_observability_values_match_the_published_ones(observability_results):
    n = observability_results
    biggest = n['one'][-1]
    assert abs(n['one'][0]) < 1e-12 * biggest and np.all(np.abs(n['up'][:2]) < 1e-12 * biggest)
    assert n['one'][1] == pytest.approx(0.2305, abs=5e-5)
    assert n['up'][2] == pytest.approx(0.714, abs=5e-4)
    assert n['two'][0] == pytest.approx(3.956, abs=5e-4)
    assert n['condition'] == pytest.approx(2571, abs=0.5)
    assert n['plain opposite'] == pytest.approx(n['condition'], rel=1e-9)
    np.testing.assert_allclose(n['kernel'], [-3, 1, 0, 1, 0, 0, 3, 3, 3], atol=1e-9)
    assert n['thrice'] < 1e-14


def test_the_best_position_of_the_second_sensor_depends_on_the_state(t10, observability_results):
    """The conclusion of T10 holds for the state at the CPA, but not for the state at the start."""
    n = observability_results
    assert n['plain best'][0] == (-2.0, 2.0) and n['plain best'][1] == pytest.approx(1110, abs=1)
    assert n['plain best same side'][0] == (-2.2, 0.0)
    assert n['plain best same side'][1] == pytest.approx(2451, abs=1)
    assert n['cpa best'][0] == (0.2, 2.0) and n['cpa best'][1] == pytest.approx(53.2, abs=0.1)
    assert n['cpa opposite'] == pytest.approx(59.3, abs=0.1)
    assert n['scaled best'][0] == (-3.6, 0.0)
    assert n['scaled best'][1] == pytest.approx(405, abs=1)
    for name in ('plain', 'cpa', 'scaled'):
        assert n[f'{name} best'][1] <= n[f'{name} best same side'][1]
    # Moving the start to the CPA gives the state at the CPA.
    t = 0.1 * np.arange(60)[:, None] - 3.0
    moved = t10.sensor_information(np.array([0.5, -1.0, 0.0]))

    def field(z):
        return dipole_field([0.5, -1.0, 0.0] - (z[:3] + t * z[3:6]), z[6:]) / t10.K_DIPOLE

    z = np.array([0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 1.0, 1.0, 1.0])
    H = np.stack([(field(z + e) - field(z - e)) / 2e-5 for e in 1e-5 * np.eye(9)], axis=-1)
    J = np.einsum('tai,taj->ij', H, H)
    np.testing.assert_allclose(t10.information_at_cpa(moved), J, rtol=1e-6,
                               atol=1e-6 * np.abs(J).max())


def test_the_threshold_and_the_ranges_match_t10(observability_results):
    """T10 states a threshold of 11.2 and an SNR of 9.2."""
    n = observability_results
    assert n['threshold'] == pytest.approx(chi2.isf(0.01, 3), rel=1e-9)
    assert ncx2.sf(n['threshold'], 3, n['snr']) == pytest.approx(0.5, rel=1e-6)
    assert n['snr'] == pytest.approx(9.31, abs=0.005)
    assert n['snr at 11.2'] == pytest.approx(9.17, abs=0.005)
    assert n['p_fa at 11.2'] == pytest.approx(0.0107, abs=5e-5)
    assert n['t10 range'] == pytest.approx(10.1, abs=0.05)
    assert list(n['ranges'].values()) == pytest.approx([9.54, 12.02, 17.33], abs=0.01)


def test_the_cost_of_simulated_passes_falls_with_the_model_order(tmp_path, capsys):
    """TSP14 Figure 7: the cost falls with the number of dipoles; for cars, nearly to one."""
    script = example('tsp14_model_order')
    found = {rate: script.fit_passes(rate, (1, 3)) for rate in script.RATES}
    (cars, truck), (cars_3, truck_3) = (script.costs_of(found['12.5 Hz'], d) for d in (1, 3))
    assert len(cars) == 3 and (np.array(cars_3) < cars).all() and truck_3 < truck
    # With one dipole at 12.5 Hz, the cars are below and the truck is above the published range.
    (lowest, _), _ = script.PUBLISHED['cars']
    (_, highest), _ = script.PUBLISHED['large']
    assert max(cars) < lowest and truck > highest and max(cars_3) < 3.0 < 20.0 < truck_3
    # At eight times the rate, model errors have less weight.
    for d, slow in ((1, [*cars, truck]), (3, [*cars_3, truck_3])):
        fast, fast_truck = script.costs_of(found['100 Hz'], d)
        assert (np.array([*fast, fast_truck]) < slow).all()
    script.fit_passes = lambda rate: found[rate]
    assert script.main(['--out', str(tmp_path)]) == 0
    for rate in ('12.5_Hz', '100_Hz'):
        assert (tmp_path / f'figure_7_{rate}.png').read_bytes().startswith(PNG_SIGNATURE)
    assert 'differs' in capsys.readouterr().out
