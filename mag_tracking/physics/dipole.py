"""The magnetic dipole: field and derivatives.

Three tiers: scalar kernels (compiled, one sensor and one source) that the
estimators call, and array functions over them for people.
"""

import math

import numpy as np
from numba import njit

MU0 = 4e-7 * math.pi
"""Vacuum permeability [T m / A], the value of the source documents."""

K_DIPOLE = 1e-7
"""mu0 / 4 pi [T m / A]."""

_COMPILE = {'cache': True, 'error_model': 'numpy', 'fastmath': {'contract'}}
"""Fused multiply-add is allowed, nothing else that would change a result."""


@njit('void(float64[::1], float64[::1], float64[::1], float64[:,::1], float64[:,::1])',
      **_COMPILE)
def field_and_jacobians(d, m, B, dB_dd, dB_dm):
    """Write field and both Jacobians of one dipole at one point.

    `d` is sensor minus source [m], `m` the moment [A m^2]; `B` (3,) [T],
    `dB_dd` (3, 3) [T/m] and `dB_dm` (3, 3) [T/(A m^2)] are written.
    All become NaN where |d| = 0.

    Source: TSP14 eq. (2), (30a), (30b), with the mu0/4pi that (30) leaves out.
    """
    d2 = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
    if d2 == 0.0:
        B[:] = np.nan
        dB_dd[:] = np.nan
        dB_dm[:] = np.nan
        return
    inv2 = 1.0 / d2
    k3 = K_DIPOLE * inv2 * math.sqrt(inv2)
    dm = d[0] * m[0] + d[1] * m[1] + d[2] * m[2]
    for i in range(3):
        B[i] = k3 * (3.0 * dm * inv2 * d[i] - m[i])
        for j in range(i, 3):
            dd = d[i] * d[j] * inv2
            jm = 3.0 * k3 * dd
            jd = 3.0 * k3 * inv2 * (d[i] * m[j] + m[i] * d[j] - 5.0 * dm * dd)
            if i == j:
                jm -= k3
                jd += 3.0 * k3 * inv2 * dm
            dB_dm[i, j] = jm
            dB_dm[j, i] = jm
            dB_dd[i, j] = jd
            dB_dd[j, i] = jd


@njit('void(float64[:,::1], float64[:,::1], float64[:,::1], float64[:,:,::1], '
      'float64[:,:,::1])', cache=True)
def _field_and_jacobians_rows(d, m, B, dB_dd, dB_dm):
    """Loop of `field_and_jacobians` over rows."""
    for i in range(d.shape[0]):
        field_and_jacobians(d[i], m[i], B[i], dB_dd[i], dB_dm[i])


@njit('void(float64[:,::1], float64[:,:,::1], float64[:,:,::1], float64[:,:,::1], '
      'float64[:,:,:,::1], float64[:,:,:,::1], float64[:,:,::1], float64[:,:,:,::1], '
      'float64[:,::1])', **_COMPILE)
def _sensor_fields(positions, R_sw, r, m, dr_dx, dm_dx, h, H, gradient_power):
    """Loop of `field_and_jacobians` over hypotheses, sensors and dipoles."""
    n_hyp, n_dip, n_t = dr_dx.shape[0], dr_dx.shape[1], dr_dx.shape[3]
    d = np.empty(3)
    b = np.empty(3)
    dB_dd = np.empty((3, 3))
    dB_dm = np.empty((3, 3))
    for p in range(n_hyp):
        for j in range(positions.shape[0]):
            h[p, j] = 0.0
            H[p, j] = 0.0
            gradient_power[p, j] = 0.0
            for s in range(n_dip):
                d2 = 0.0
                m2 = 0.0
                for i in range(3):
                    d[i] = positions[j, i] - r[p, s, i]
                    d2 += d[i] * d[i]
                    m2 += m[p, s, i] * m[p, s, i]
                field_and_jacobians(d, m[p, s], b, dB_dd, dB_dm)
                gradient_power[p, j] += K_DIPOLE * K_DIPOLE * m2 / (d2 * d2 * d2 * d2)
                # Turned into the sensor's frame first: 3 x 3 products are cheaper than 3 x n_t.
                for i in range(3):
                    for k in range(3):
                        g, q = 0.0, 0.0
                        for u in range(3):
                            g += R_sw[j, i, u] * dB_dd[u, k]
                            q += R_sw[j, i, u] * dB_dm[u, k]
                        h[p, j, i] += R_sw[j, i, k] * b[k]
                        for c in range(n_t):
                            H[p, j, i, c] += q * dm_dx[p, s, k, c] - g * dr_dx[p, s, k, c]


def sensor_fields(positions, R_sw, r, m, dr_dx, dm_dx):
    """Field of moving dipoles at fixed sensors, with its derivative by the state.

    Parameters
    ----------
    positions : (n_sensors, 3) [m], world
    R_sw : (n_sensors, 3, 3)
        Rotations world to sensor.
    r, m : (n_hyp, n_dipoles, 3) [m], [A m^2], world
        Positions and moments.
    dr_dx, dm_dx : (n_hyp, n_dipoles, 3, n_t)
        Their derivatives by the target state.

    Returns
    -------
    h : (n_hyp, n_sensors, 3) [T], sensor frame
    H : (n_hyp, n_sensors, 3, n_t)
    gradient_power : (n_hyp, n_sensors) [T^2/m^2]
        Sum of (mu0/4pi |m|)^2 / |d|^8: the first neglected multipole term for
        a target of one metre (ICASSP11 eq. (9)).
        NaN and infinite where a dipole sits on a sensor.
    """
    n_hyp, n_sensors, n_t = len(r), len(positions), dr_dx.shape[-1]
    h = np.empty((n_hyp, n_sensors, 3))
    H = np.empty((n_hyp, n_sensors, 3, n_t))
    gradient_power = np.empty((n_hyp, n_sensors))
    _sensor_fields(positions, R_sw, r, m, dr_dx, dm_dx, h, H, gradient_power)
    return h, H, gradient_power


def _evaluate(r, m):
    """Broadcast, flatten, run the kernel; field and Jacobians in the broadcast shape."""
    r, m = np.broadcast_arrays(np.asarray(r, dtype=float), np.asarray(m, dtype=float))
    if r.shape[-1:] != (3,):
        raise ValueError(f'r and m need a last axis of length 3, got {r.shape}')
    shape = r.shape
    r = np.ascontiguousarray(r).reshape(-1, 3)
    m = np.ascontiguousarray(m).reshape(-1, 3)
    B = np.empty_like(r)
    dB_dd = np.empty((len(r), 3, 3))
    dB_dm = np.empty((len(r), 3, 3))
    _field_and_jacobians_rows(r, m, B, dB_dd, dB_dm)
    return B.reshape(shape), dB_dd.reshape(shape + (3,)), dB_dm.reshape(shape + (3,))


def dipole_field(r, m):
    """Flux density of a point dipole.

    Parameters
    ----------
    r : (..., 3) [m], world
        Sensor minus source position.
    m : (..., 3) [A m^2], world
        Dipole moment; broadcasts against `r`.

    Returns
    -------
    (..., 3) [T], world
        NaN where |r| = 0.

    Source: TSP14 eq. (2).
    """
    return _evaluate(r, m)[0]


def dipole_jacobians(r, m):
    """Derivatives of the dipole field.

    Parameters
    ----------
    r : (..., 3) [m], world
        Sensor minus source position.
    m : (..., 3) [A m^2], world
        Dipole moment; broadcasts against `r`.

    Returns
    -------
    dB_dr : (..., 3, 3) [T/m]
        With respect to `r`; the one with respect to the source is its negative.
    dB_dm : (..., 3, 3) [T/(A m^2)]
        Both symmetric; NaN where |r| = 0.

    Source: TSP14 eq. (30a), (30b), with the factor mu0/4pi.
    """
    return _evaluate(r, m)[1:]
