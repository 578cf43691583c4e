"""Compiled functions of inference that run for every frame."""

from mag_tracking.arrays import FloatArray, IntArray

def energies(y: FloatArray, C: FloatArray, energy: FloatArray, axes: IntArray) -> bool:
    """Write `covariances.whitened_energy` to `energy` and `axes`.

    Return False if a covariance is not positive definite.
    """

def smallest_pivots(y: FloatArray, C: FloatArray, out: FloatArray) -> None:
    """Write `covariances.smallest_pivots` to `out`."""

def step_vectors(x: FloatArray, P: FloatArray, log_w: FloatArray, densities: FloatArray,
                 vector: IntArray, H: FloatArray, y: FloatArray, variance: FloatArray, dt: float,
                 switch_s: float) -> float:
    """Return `GaussMarkovVectors.log_density`.

    Update the states `x` (n, n_strengths, n_x), their covariances `P` and the log-weights
    (n, n_strengths) in place.
    """

def inverses(A: FloatArray, least: float, out: FloatArray) -> bool:
    """Write the inverses of symmetric matrices `A` (n, k, k) to `out`.

    Return False if a matrix is not finite, or if the root of a pivot of a matrix scaled to unit
    diagonal does not exceed `least`.
    """

def best(x: FloatArray, P: FloatArray, log_w: FloatArray, label: IntArray, kind: IntArray,
         negligible: float) -> int:
    """Return `FilterBank.best`.

    Hypotheses lighter than the heaviest one by more than `negligible` [nats] are ignored.
    """
