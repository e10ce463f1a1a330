"""
Clock offset of fixes, estimated beside the filter from its innovations.

A fix that was valid a time tau after its stamp is displaced by v tau. The filter follows part of
that: its state has a sensitivity s = d(error)/d(tau), which is propagated by the error dynamics
and corrected as the state is, so that the innovation has the mean (H s + v) tau. For the filter tau
is a constant: regressing the innovations on that factor is what an augmented filter would do, [1]_,
and the filter itself is not changed by it.

References
----------
.. [1] B. Friedland, "Treatment of bias in recursive filtering", IEEE Transactions on Automatic
       Control 14, 1969.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.linalg import factorise, solve
from hybrid_ins.core.noise import Correction
from hybrid_ins.core.noise_multiple_model_step import mean_system
from hybrid_ins.core.state import DP, DV, N_ERROR, QUAT, VELOCITY
from hybrid_ins.core.strapdown import rotation

Array = NDArray[np.float64]

RANDOM_WALK = 1e-3  # s per sqrt(s), of one clock against the other
NONLINEARITY = (
    0.5  # of a shift: its standard deviation afterwards, since the motion is not linear in it
)
MIN_STD = 1e-3  # s: stamps of receivers and drivers are no better
MAX_INTERVAL = 60.0  # s without a fix after which the sensitivity starts anew
MAX_SENSITIVITY = 10.0  # of the position, in (the vehicle's speed + 1 m/s)
NIS_MEMORY = 40.0  # corrections over which the normalised NIS is averaged


class ClockOffsetObserver:
    """
    Estimates the offset that is still to be added to the stamps of fixes.

    Arrays are replaced, never changed in place: a shallow copy is a checkpoint.

    Parameters
    ----------
    std : float
        Standard deviation at the start [s].

    Attributes
    ----------
    residual : float
        Offset still to be added to the stamps of fixes [s].
    """

    def __init__(self, std: float) -> None:
        self.residual = 0.0
        self._variance = std**2
        self._s: Array | None = None
        self._t_ns = 0
        self._velocity_n = np.zeros(3)
        self._C_nb = np.eye(3)
        self._nis_scale = 1.0

    @property
    def sigma(self) -> float:
        """Standard deviation of `residual` [s]."""
        return math.sqrt(self._variance * max(self._nis_scale, 1.0))

    def update(self, correction: Correction) -> None:
        """Take a correction, or a measurement that was rejected, into account."""
        nav = correction.nav
        velocity_n = nav[VELOCITY].copy()
        T = (correction.t_ns - self._t_ns) * 1e-9
        if self._s is not None:
            self._variance += RANDOM_WALK**2 * max(T, 0.0)
        if not 0.0 <= T <= MAX_INTERVAL or not _is_plausible(self._s, velocity_n):
            self._s = None
        if self._s is None:
            self._s, T = initial_sensitivity(velocity_n), 0.0
        s, acceleration_n, C_nb = propagate_sensitivity(
            self._s, nav, self._velocity_n, self._C_nb, T
        )
        if correction.fused:
            information, gradient, nis = regress(
                s,
                velocity_n,
                acceleration_n,
                correction.z,
                correction.H,
                correction.S,
                correction.K,
                self.residual,
            )
            self._nis_scale += (nis / len(correction.z) - self._nis_scale) / NIS_MEMORY
            self._variance /= 1.0 + self._variance * information
            self.residual += self._variance * gradient
            self._variance = max(self._variance, MIN_STD**2)
        self._s, self._t_ns = s, correction.t_ns
        self._velocity_n, self._C_nb = velocity_n + correction.dx[DV], C_nb

    def set_estimate(self, residual: float, sigma: float) -> None:
        """Replace estimate and standard deviation [s] by those of a mixture of filters."""
        self.residual = residual
        self._variance = max(sigma**2 / max(self._nis_scale, 1.0), MIN_STD**2)

    def shift(self, by: float) -> Array:
        """Note that ``by`` [s] more is added from now on; return the state's error by it, (15,)."""
        self.residual -= by
        self._variance += (NONLINEARITY * by) ** 2
        moved = np.zeros(N_ERROR) if self._s is None else by * self._s
        self._velocity_n = self._velocity_n + moved[DV]
        return moved

    def restart(self, velocity_n: Array) -> None:
        """Start the sensitivity anew: the state was moved to where the fixes are."""
        self._s = initial_sensitivity(velocity_n)
        self._velocity_n = velocity_n.copy()


def _is_plausible(s: Array | None, velocity_n: Array) -> bool:
    """
    Return whether a sensitivity, shape (15,), can come from the vehicle's motion.

    It is propagated by the mean motion between fixes, not by the filter's own transitions, and may
    therefore grow without bound where little corrects it.
    """
    limit = MAX_SENSITIVITY * (1.0 + float(np.linalg.norm(velocity_n)))
    return s is None or bool(np.linalg.norm(s[DP]) <= limit)  # False where it is not finite


def initial_sensitivity(velocity_n: Array) -> Array:
    """Return the sensitivity, shape (15,), of a state that follows the fixes."""
    s = np.zeros(N_ERROR)
    s[DP] = -velocity_n
    return s


@kernel()
def propagate_sensitivity(s, nav, velocity_n, C_nb, T):  # type: ignore[no-untyped-def]
    """
    Propagate the sensitivity by the error dynamics.

    Parameters
    ----------
    s : ndarray, shape (15,)
        After the last correction.
    nav : ndarray, shape (N_FLAT,)
        Flat state now.
    velocity_n, C_nb : ndarray, shape (3,), (3, 3)
        After the last correction.
    T : float
        Time since then [s].

    Returns
    -------
    s, acceleration_n, C_nb : ndarray, shape (15,), (3,), (3, 3)
        Now; the acceleration is the mean since then.
    """
    C_now, acceleration_n = np.empty(9), np.zeros(3)
    rotation(nav[QUAT], C_now)
    moved = s.copy()
    if T > 0.0:
        for i in range(3):
            acceleration_n[i] = (nav[VELOCITY][i] - velocity_n[i]) / T
        F, _ = mean_system(nav, velocity_n, C_nb, T)
        term = s.copy()
        for order in range(1, 4):
            last = term.copy()
            for i in range(N_ERROR):
                total = 0.0
                for k in range(N_ERROR):
                    total += F[i, k] * last[k]
                term[i] = total * T / order
                moved[i] += term[i]
    return moved, acceleration_n, C_now.reshape(3, 3)


@kernel()
def regress(s, velocity_n, acceleration_n, z, H, S, K, residual):  # type: ignore[no-untyped-def]
    """
    Regress an innovation on the clock offset; the sensitivity ``s`` is corrected in place.

    Parameters
    ----------
    s, velocity_n, acceleration_n : ndarray, shape (15,), (3,), (3,)
        Now.
    z, H, S, K : ndarray, shape (m,), (m, 15), (m, m), (15, m)
        See `Correction`.
    residual : float
        Estimate of the offset so far [s].

    Returns
    -------
    information, gradient, nis : float
        With the innovation's factor h on the offset, and r = z - h residual:
        h' S^-1 h, h' S^-1 r, r' S^-1 r.
    """
    m = len(z)
    factor, rest = np.empty(m), np.empty(m)
    for a in range(m):
        total = 0.0
        for k in range(N_ERROR):
            total += H[a, k] * s[k]
        for i in range(3):
            total += H[a, i] * velocity_n[i] + H[a, 3 + i] * acceleration_n[i]
        factor[a], rest[a] = total, z[a] - total * residual
    root = S.copy()
    factorise(root)
    weighted_factor, weighted_rest = factor.copy(), rest.copy()
    solve(root, weighted_factor)
    solve(root, weighted_rest)
    information, gradient, nis = 0.0, 0.0, 0.0
    for a in range(m):
        information += factor[a] * weighted_factor[a]
        gradient += factor[a] * weighted_rest[a]
        nis += rest[a] * weighted_rest[a]
        for i in range(N_ERROR):
            s[i] -= K[i, a] * factor[a]
    return information, gradient, nis
