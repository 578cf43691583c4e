"""Compiled functions: rejected shapes and types of arrays, and unmodified arguments."""

import numpy as np
import pytest

from mag_tracking.physics import core
from mag_tracking.physics.dipole import K_DIPOLE, MU0
from mag_tracking.physics.passes import N_PATH

RNG = np.random.default_rng(3)
HYPOTHESES, SENSORS, DIPOLES, STATES, SAMPLES = 2, 4, 3, 19, 5


def normal(*shape):
    return RNG.standard_normal(shape)


PASS = {'offsets': np.linspace(-0.5, 0.5, DIPOLES), 't': normal(SAMPLES),
        'positions': normal(SAMPLES, 3), 'M': normal(SAMPLES, 3, 3)}
MOMENTS = normal(HYPOTHESES, 3 * DIPOLES)
CLOCK = np.array([-1, 0, 1, -1, 0])
CURVED_PATHS = normal(HYPOTHESES, N_PATH + 2)
CALLS = {
    'dipole_field': {'d': normal(4, 3), 'm': normal(4, 3)},
    'dipole_jacobians': {'d': normal(4, 3), 'm': normal(4, 3)},
    'sensor_fields': {
        'positions': normal(SENSORS, 3), 'R_sw': normal(SENSORS, 3, 3),
        'r': normal(HYPOTHESES, DIPOLES, 3), 'm': normal(HYPOTHESES, DIPOLES, 3),
        'dr_dx': normal(HYPOTHESES, DIPOLES, 3, STATES),
        'dm_dx': normal(HYPOTHESES, DIPOLES, 3, STATES)},
    'rotated_fields': {
        'h': normal(HYPOTHESES, SENSORS, 3), 'H': normal(HYPOTHESES, SENSORS, 3, STATES),
        'angles': normal(HYPOTHESES, SENSORS, 3)},
    'propagate_turn': {'x': normal(HYPOTHESES, STATES), 'dt': 0.1, 'mean_factor': 1.0,
                       'final_factor': 1.0},
    'row_dipoles': {'x': normal(HYPOTHESES, STATES), 'n_dipoles': DIPOLES,
                    'field_strength': normal(3)},
    'row_bases': {'theta': normal(HYPOTHESES, 7), **PASS},
    'row_derivatives': {'theta': normal(HYPOTHESES, 7), 'moments': MOMENTS, **PASS},
    'steady_bases': {'theta': CURVED_PATHS, **PASS, 'clock': CLOCK},
    'steady_derivatives': {'theta': CURVED_PATHS, 'moments': MOMENTS, **PASS, 'clock': CLOCK},
    'anderson_residual': {'t': normal(20), 'y': normal(20, 2), 'time': 0.1, 'scale': 1.0},
}
INDEPENDENT_AXES = {
    ('rotated_fields', 'H', 3), ('propagate_turn', 'x', 0), ('propagate_turn', 'x', 1),
    ('row_dipoles', 'x', 0), ('row_dipoles', 'x', 1), ('row_bases', 'theta', 0),
    ('row_bases', 'offsets', 0), ('steady_bases', 'theta', 0), ('steady_bases', 'theta', 1),
    ('steady_bases', 'offsets', 0), ('steady_derivatives', 'theta', 1),
    ('anderson_residual', 'y', 1)}
"""Axes (function, argument, axis) whose length does not depend on the other arguments."""

ARRAYS = [(name, argument) for name, call in CALLS.items() for argument, value in call.items()
          if isinstance(value, np.ndarray)]


def test_every_function_has_an_example():
    assert set(CALLS) == {name for name, value in vars(core).items()
                          if callable(value) and not name.startswith('_')}


@pytest.mark.parametrize(('name', 'argument'), ARRAYS)
def test_an_array_of_another_shape_is_rejected(name, argument):
    value = CALLS[name][argument]
    others = [np.repeat(value, 2, axis=axis) for axis in range(value.ndim)
              if (name, argument, axis) not in INDEPENDENT_AXES]
    for other in (*others, value[None].copy(), value[0].copy()):
        with pytest.raises((ValueError, TypeError)):
            getattr(core, name)(**{**CALLS[name], argument: other})


@pytest.mark.parametrize(('name', 'argument'), ARRAYS)
def test_an_array_of_another_type_or_layout_is_rejected(name, argument):
    value = CALLS[name][argument]
    strided = np.repeat(value, 2, axis=-1)[..., ::2]
    for other in (value.astype(np.float32), value.astype(np.complex128), strided):
        with pytest.raises(TypeError):
            getattr(core, name)(**{**CALLS[name], argument: other})


@pytest.mark.parametrize('name', CALLS)
def test_arguments_are_not_modified(name):
    call = {k: v.copy() if isinstance(v, np.ndarray) else v for k, v in CALLS[name].items()}
    for value in call.values():
        if isinstance(value, np.ndarray):
            value.flags.writeable = False
    results = [getattr(core, name)(**arguments) for arguments in (call, CALLS[name])]
    for a, b in zip(*(r if isinstance(r, tuple) else (r,) for r in results), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize('name', ['steady_bases', 'steady_derivatives'])
def test_a_clock_index_outside_theta_is_rejected(name):
    with pytest.raises(ValueError, match='clock'):
        getattr(core, name)(**{**CALLS[name], 'clock': np.array([0, 1, 2, 0, 0])})
    with pytest.raises(ValueError, match='theta'):
        getattr(core, name)(**{**CALLS[name], 'theta': CURVED_PATHS[:, :N_PATH - 1].copy()})


@pytest.mark.parametrize('n_dipoles', [-1, 0, 4])
def test_a_state_of_another_number_of_dipoles_is_rejected(n_dipoles):
    with pytest.raises(ValueError, match='dipoles'):
        core.row_dipoles(**{**CALLS['row_dipoles'], 'n_dipoles': n_dipoles})


def test_a_state_without_turn_rate_is_rejected():
    with pytest.raises(ValueError, match='turn rate'):
        core.propagate_turn(normal(2, 6), 0.1, 1.0, 1.0)


def test_dipole_constant_equals_mu0_over_4_pi():
    assert pytest.approx(MU0 / (4.0 * np.pi), rel=1e-15) == K_DIPOLE
