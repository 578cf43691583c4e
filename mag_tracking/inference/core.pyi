"""What of inference is computed for every frame, compiled."""

from mag_tracking.arrays import FloatArray, IntArray

def energies(y: FloatArray, C: FloatArray, energy: FloatArray, axes: IntArray) -> bool:
    """`axes.whitened_energy`; False where a covariance is not positive definite."""

def smallest_pivots(y: FloatArray, C: FloatArray, out: FloatArray) -> None:
    """`axes.smallest_pivots`."""

def step_vectors(x: FloatArray, P: FloatArray, log_w: FloatArray, densities: FloatArray,
                 vector: IntArray, H: FloatArray, y: FloatArray, variance: FloatArray, dt: float,
                 switch_s: float) -> float:
    """`GaussMarkovVectors.log_density`; the states (n, n_strengths, n_x), their covariances
    and the log weights (n, n_strengths) are changed."""

def inverses(A: FloatArray, least: float, out: FloatArray) -> bool:
    """Inverses of the symmetric `A` (n, k, k) into `out`; False where the least root of a pivot of
    one, scaled to unit diagonal, is not larger than `least`, or one is not finite."""

def best(x: FloatArray, P: FloatArray, log_w: FloatArray, label: IntArray, kind: IntArray,
         negligible: float) -> int:
    """`FilterBank.best`, without hypotheses that are lighter than the heaviest by `negligible`."""
