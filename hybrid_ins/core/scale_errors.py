"""
Errors of an IMU's scale factors and of the directions of its axes, considered in the covariance.

They are constant: the readings are f + M_a f and ω + M_g ω with small unknown matrices M_a and M_g,
(3, 3). While fixes come the biases follow M f₀ and M ω₀ of the mean motion, and the innovations
show the rest. Where fixes are missing the errors grow by M (f - f₀) and M (ω - ω₀). M is not
estimated but considered, [1]_: its correlation with the errors of the state is kept, so that a
manoeuvre that ends as it began takes away most of what it has brought.

References
----------
.. [1] S. Schmidt, "Application of state-space methods to navigation problems", Advances in Control
       Systems 3, 1966.
.. [2] P. Groves, *Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems*,
       2nd ed., section 4.4.2 (scale factor and cross-coupling errors).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.error_model import system_matrix
from hybrid_ins.core.rotations import matrix_from_quat, quat_from_rotvec
from hybrid_ins.core.samples import SAMPLE_DTYPE, ImuRing, readings_of, steps_since
from hybrid_ins.core.state import (
    B_A,
    BIAS_A,
    BIAS_G,
    COVARIANCE,
    LAST_F,
    LAST_W,
    LLA,
    N_ERROR,
    QUAT,
    VELOCITY,
    covariance,
    pack,
)

Array = NDArray[np.float64]

STEP = 0.1  # s, in which the motion is taken for constant
N_SCALE = 18  # elements of M_a and M_g, row by row
AXES = 0.5  # of the deviation of a scale factor: that of an axis' direction [rad], by data sheets
SHARES = np.tile(np.where(np.eye(3) > 0.0, 1.0, AXES).ravel(), 2)  # the same, by element


@dataclass(frozen=True, slots=True)
class ConsideredScaleErrors:
    """
    Scale errors in the covariance of a filter, since its last fix.

    Attributes
    ----------
    t_ns : int
        Stamp up to which they are in it [ns].
    mean : ndarray, shape (6,)
        f₀ [m/s²] and ω₀ [rad/s], b.
    std : float
        Standard deviation of the elements on the diagonals of M_a and M_g.
    correlation : ndarray, shape (15, N_SCALE)
        S = E[δx mᵀ] at that stamp, with the elements m of M_a and M_g in units of
        their deviations, ``std`` times `SHARES`.
    """

    t_ns: int
    mean: Array
    std: float
    correlation: Array = field(default_factory=lambda: np.zeros((N_ERROR, N_SCALE)))

    def grown(self, nav: Array, ring: ImuRing, t_ns: int) -> ConsideredScaleErrors:
        """
        Add what they have done up to a stamp to a covariance.

        With δx ← Φ δx + D m, and P propagated without them, P ← P + Φ S Dᵀ + D Sᵀ Φᵀ + D Dᵀ and
        S ← Φ S + D.

        Parameters
        ----------
        nav : ndarray, shape (N_FLAT,)
            Flat state at that stamp with nothing pending; its covariance is changed in place.
        ring : ImuRing
            Holds the samples up to there.
        t_ns : int
            The stamp [ns].
        """
        if t_ns <= self.t_ns:
            return self
        samples = ring.between(self.t_ns, t_ns)
        if not len(samples) or samples["t_ns"][-1] < t_ns:
            last = np.array([(t_ns, nav[LAST_F], nav[LAST_W])], SAMPLE_DTYPE)
            samples = np.concatenate((samples, last))
        transition, drive = sensitivity(nav, self.t_ns, samples, self.mean)
        before = transition @ self.correlation
        after = before + self.std * SHARES * drive
        pack(covariance(nav) + after @ after.T - before @ before.T, nav[COVARIANCE])
        return replace(self, t_ns=t_ns, correlation=after)

    def corrected(self, H: Array, K: Array, G: Array) -> ConsideredScaleErrors:
        """
        Follow a correction of the state: S ← G S - K H S.

        Parameters
        ----------
        H, K, G : ndarray, shape (m, 15), (15, m), (15, 15)
            Measurement matrix and G as `iterated_update.linearisation` returns them, and the gain
            as `iterated_update.update` does.
        """
        S = self.correlation
        return replace(self, correlation=G @ S - K @ (H @ S))


def sensitivity(
    nav: Array, since_ns: int, samples: NDArray[np.void], mean: Array
) -> tuple[Array, Array]:
    """
    Return Φ, shape (15, 15), and D, shape (15, N_SCALE), of δx ← Φ δx + D m over samples.

    Parameters
    ----------
    nav : ndarray, shape (N_NAV,) or longer
        Flat state at the last sample.
    since_ns : int
        Stamp at which they begin [ns].
    samples : ndarray of ``SAMPLE_DTYPE``
        At least one.
    mean : ndarray, shape (6,)
        f₀ [m/s²] and ω₀ [rad/s], b.
    """
    dt = steps_since(since_ns, samples["t_ns"]) * 1e-9
    parts = max(1, round(float(dt.sum()) / STEP))
    first = np.unique(np.linspace(0, len(dt), parts, endpoint=False, dtype=np.int64))
    lengths = np.add.reduceat(dt, first)
    readings = np.add.reduceat(dt[:, None] * readings_of(samples), first) / lengths[:, None]
    attitudes = _attitudes(matrix_from_quat(nav[QUAT]), readings[:, 3:] - nav[BIAS_G], lengths)
    transition, drive = np.eye(N_ERROR), np.zeros((N_ERROR, N_SCALE))
    F = np.zeros((N_ERROR, N_ERROR))
    for C_nb, reading, length in zip(attitudes, readings, lengths, strict=True):
        system_matrix(nav[LLA], nav[VELOCITY], C_nb @ (reading[:3] - nav[BIAS_A]), C_nb.ravel(), F)
        # M (f - f₀) is an error of a reading, as a bias is; half of it before, half behind a step.
        half = 0.5 * length * (reading - mean).reshape(2, 1, 3)
        error = (F[:, B_A.start :].reshape(N_ERROR, 2, 3, 1) * half).reshape(N_ERROR, N_SCALE)
        step = np.eye(N_ERROR) + length * F + 0.5 * length**2 * F @ F
        transition, drive = step @ transition, step @ (drive + error) + error
    return transition, drive


def _attitudes(C_nb: Array, rates_b: Array, lengths: Array) -> Array:
    """Return C_nb (M, 3, 3) in the middle of each of M parts, from that at the end of the last."""
    halves = matrix_from_quat(quat_from_rotvec(-0.5 * lengths[:, None] * rates_b))
    found = np.empty((len(lengths), 3, 3))
    for k in range(len(lengths) - 1, -1, -1):
        found[k] = C_nb @ halves[k]
        C_nb = found[k] @ halves[k]
    return found
