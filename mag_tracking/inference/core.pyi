"""Compiled functions of inference that run for every frame."""

from mag_tracking.arrays import FloatArray, IntArray

def energies(y: FloatArray, C: FloatArray, energy: FloatArray, axes: IntArray) -> bool:
    """`axes.whitened_energy`, written to `energy` and `axes`; False if a covariance is not positive
    definite.
    """

def smallest_pivots(y: FloatArray, C: FloatArray, out: FloatArray) -> None:
    """`axes.smallest_pivots`, written to `out`."""

def step_vectors(x: FloatArray, P: FloatArray, log_w: FloatArray, densities: FloatArray,
                 vector: IntArray, H: FloatArray, y: FloatArray, variance: FloatArray, dt: float,
                 switch_s: float) -> float:
    """`GaussMarkovVectors.log_density`; updates the states `x` (n, n_strengths, n_x), their
    covariances `P` and the log-weights (n, n_strengths) in place.
    """

def inverses(A: FloatArray, least: float, out: FloatArray) -> bool:
    """Inverses of symmetric matrices `A` (n, k, k), written to `out`.

    False if a matrix is not finite, or if the root of a pivot of one, at unit diagonal, is not
    above `least`.
    """

def best(x: FloatArray, P: FloatArray, log_w: FloatArray, label: IntArray, kind: IntArray,
         negligible: float) -> int:
    """`FilterBank.best`, ignoring hypotheses lighter than the heaviest by more than `negligible`
    [nats].
    """
