"""Something else than a target: smooth fields, and how well they explain the frames of a track.

A member of every bank, with evidence of its own. Either each sensor has a field of its own
(temperature, a knock, a cable), or one field with a gradient covers the network (a geomagnetic
storm, a power line, a tram). The error that the tracker allows the model of its target is allowed
here, too: else anything smooth would win where a target is near.
"""

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.inference.filter_bank import log_sum_exp
from mag_tracking.inference.gauss_markov import GaussMarkovVectors
from mag_tracking.network import SensorNetwork
from mag_tracking.records import FieldFrame

GRADIENT_SHARE = 0.3
"""How much a field over the network may change from its centre to its edge, as a share."""

MIN_STD = 1e-15
"""[T] No sensor is quieter: a network file with less noise is refused."""

UNKNOWN_FIELD_STD = 1e-4
"""[T] Deviation of a field that is not known."""

MIN_GRADIENT_SENSORS = 3
"""Sensors below which a uniform field with a gradient is any field."""

MAX_COMMON_SENSORS = 8
"""One field is sought over so many sensors; the cost grows with the cube of their number."""


class DisturbanceModel:
    """Evidence for fields of no target."""

    def __init__(self, network: SensorNetwork, background_std: float,
                 is_handover: bool = False) -> None:
        """From the first frame of a track on, when there is no field; or, in a handover, from the
        first of these sensors on, whose fields are then unknown.
        """
        n = len(network)
        self._background_std, self._is_handover = background_std, is_handover
        self._sensor, self._own_H = np.repeat(np.arange(n), 3), np.tile(np.eye(3), (n, 1))
        # One field is sought over the first sensors; the rest have fields of their own.
        chosen = np.arange(min(n, MAX_COMMON_SENSORS))
        self._common_H = _common_field_matrix(network.part(chosen) if n > len(chosen) else network)
        self._filters: tuple[GaussMarkovVectors, GaussMarkovVectors, GaussMarkovVectors] | None \
            = None
        # Log-weights of a field of each sensor's own, and of one field over the network.
        self._log_w = np.log([0.5, 0.5])

    @property
    def uniform(self) -> float:
        """Probability that it is one field over the network, given that it is no target."""
        return float(np.exp(self._log_w[1]))

    def log_density(self, frame: FieldFrame, dt: float, model_error: FloatArray) -> float | None:
        """Log-density of a frame given those before; None for the first one after a handover.

        Parameters
        ----------
        frame : FieldFrame
        dt : float [s]
            Since the frame before.
        model_error : (n_sensors,) array, T^2
            Variance that the model of a target is allowed, per axis.
        """
        present = np.isfinite(frame.field.ravel())
        noise = np.einsum('jii->ji', frame.covariance)
        variance = np.maximum(noise + model_error[:, None], MIN_STD**2).ravel()[present]
        y = frame.field.ravel()[present]
        is_first = self._filters is None and self._is_handover
        if self._filters is None:
            if not len(y):
                return 0.0
            self._begin(float(np.median(noise.ravel()[present])))
        assert self._filters is not None
        own, rest, common = self._filters
        sensor, H = self._sensor[present], self._own_H[present]
        k = int(np.searchsorted(sensor, MAX_COMMON_SENSORS))
        of_rest = rest.log_density(sensor[k:] - MAX_COMMON_SENSORS, H[k:], y[k:], variance[k:], dt)
        joint = self._log_w + of_rest + [
            own.log_density(sensor[:k], H[:k], y[:k], variance[:k], dt),
            common.log_density(np.zeros(k, dtype=np.int64),
                               self._common_H[present[:len(self._common_H)]], y[:k],
                               variance[:k], dt)]
        evidence = float(log_sum_exp(joint))
        self._log_w = joint - evidence
        return None if is_first else evidence

    def _begin(self, noise: float) -> None:
        """The first measurement has this variance [T^2]: it sets the scale."""
        scale = np.sqrt(self._background_std**2 + noise)
        n = len(self._sensor) // 3
        n_chosen = min(n, MAX_COMMON_SENSORS)
        n_field = self._common_H.shape[1] - 3 * n_chosen
        std = UNKNOWN_FIELD_STD if self._is_handover else self._background_std
        # Behind the field are the backgrounds, which stay as they are.
        scales = scale * np.concatenate([np.ones(3), np.full(n_field - 3, GRADIENT_SHARE),
                                         np.zeros(3 * n_chosen)])
        each = np.full(3, scale)
        self._filters = (GaussMarkovVectors(n_chosen, each, std),
                         GaussMarkovVectors(n - n_chosen, each, std),
                         GaussMarkovVectors(1, scales, std))


def _common_field_matrix(network: SensorNetwork) -> FloatArray:
    """(3 n_sensors, m) each sensor's axes of a field over the network, and of the backgrounds.

    The field is uniform, with a gradient. Without sources in the network that is symmetric and free
    of trace: five numbers, in units of a field over the network's radius.
    """
    n, R_sw = len(network), network.R_sw
    field = np.tile(np.eye(3), (n, 1, 1))
    if n >= MIN_GRADIENT_SENSORS:
        away = network.positions - network.centre
        radius = np.linalg.norm(away, axis=1).max()
        x, y, z = (away / (radius or 1.0)).T
        zero = np.zeros(n)
        # Columns: Gxx, Gyy, Gxy, Gxz, Gyz; Gzz = -Gxx - Gyy.
        gradient = np.stack([np.stack([x, zero, y, z, zero], axis=1),
                             np.stack([zero, y, x, zero, z], axis=1),
                             np.stack([-z, -z, zero, x, y], axis=1)], axis=1)
        field = np.concatenate([field, gradient], axis=2)
    return np.hstack([(R_sw @ field).reshape(3 * n, -1), np.eye(3 * n)])
