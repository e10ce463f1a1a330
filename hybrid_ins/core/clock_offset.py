"""
Clock offset of fixes, estimated beside the filter from its innovations.

A fix that was valid a time tau after its stamp is displaced by v tau. The filter follows part of
that: its state has the error s tau, and an innovation the mean h tau with h = H s + v (of a
velocity: H s + a). For the filter tau is a constant, so its sensitivity s = d(error)/d(tau) obeys
the filter's own equations, [1]_::

    s <- Phi s              with every step of the covariance (`propagation`)
    s <- s - K h            with every correction, h = H s where the measurement has no clock

The s that these give is as stable as the filter is. Regressing the innovations on h is what a
filter with tau among its states would do; the filter itself is not changed by it.

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
from hybrid_ins.core.state import DP, DV, N_ERROR, SENSITIVITY, VELOCITY

Array = NDArray[np.float64]

RANDOM_WALK = 1e-3  # s per sqrt(s), of one clock against the other
MIN_STD = 1e-3  # s: stamps are no better than that
NONLINEARITY = 0.5  # of a shift: its standard deviation afterwards, since the motion is not linear
MAX_INTERVAL = 60.0  # s without a fix, over which a mean acceleration is meaningful
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
        self._nis_scale = 1.0
        self._t_ns = 0  # of the last correction
        self._velocity_n = np.zeros(3)  # after it

    @property
    def sigma(self) -> float:
        """Standard deviation of `residual` [s]."""
        return math.sqrt(self._variance * max(self._nis_scale, 1.0))

    def sensitivity_of(self, nav: Array, t_ns: int, H: Array) -> Array:
        """
        Return the sensitivity h, shape (m,), of an innovation of fixes to the offset.

        Parameters
        ----------
        nav : ndarray, shape (N_FLAT,)
            Flat state before the correction.
        t_ns : int
            Stamp of the fix [ns].
        H : ndarray, shape (m, 15)
            Measurement matrix.
        """
        T = (t_ns - self._t_ns) * 1e-9
        acceleration_n = np.zeros(3)
        if 0.0 < T <= MAX_INTERVAL:
            acceleration_n = (nav[VELOCITY] - self._velocity_n) / T
        return np.asarray(
            H @ nav[SENSITIVITY] + H[:, DP] @ nav[VELOCITY] + H[:, DV] @ acceleration_n
        )

    def update(self, correction: Correction, h: Array, S: Array) -> None:
        """
        Take a correction, or a fix that was rejected, into account.

        Parameters
        ----------
        correction : Correction
            What the fix did to the state.
        h : ndarray, shape (m,)
            `sensitivity_of` its innovation.
        S : ndarray, shape (m, m)
            Covariance of the innovation, with R as it was fused.
        """
        T = (correction.t_ns - self._t_ns) * 1e-9
        if self._t_ns and T > 0.0:
            self._variance += RANDOM_WALK**2 * T
        if correction.fused:
            information, gradient, nis = regress(correction.z, h, S, self.residual)
            self._nis_scale += (nis / len(correction.z) - self._nis_scale) / NIS_MEMORY
            self._variance /= 1.0 + self._variance * information
            self.residual += self._variance * gradient
            self._variance = max(self._variance, MIN_STD**2)
        self._t_ns = correction.t_ns
        self._velocity_n = correction.nav[VELOCITY] + correction.dx[DV]

    def set_estimate(self, residual: float, sigma: float) -> None:
        """Replace estimate and standard deviation [s] by those of a mixture of filters."""
        self.residual = residual
        self._variance = max(sigma**2 / max(self._nis_scale, 1.0), MIN_STD**2)

    def shift(self, by: float, nav: Array) -> Array:
        """
        Note that ``by`` [s] more is added from now on.

        Returns the error, shape (15,), that the flat state ``nav`` has because it was not.
        """
        self.residual -= by
        self._variance += (NONLINEARITY * by) ** 2
        moved = by * nav[SENSITIVITY]
        self._velocity_n = self._velocity_n + moved[DV]
        return np.asarray(moved)

    def on_moved_state(self, velocity_n: Array) -> None:
        """Note that the state was changed by other means than a correction."""
        self._velocity_n = velocity_n.copy()


def initial_sensitivity(velocity_n: Array) -> Array:
    """Return the sensitivity, shape (15,), of a state that was read off the fixes."""
    s = np.zeros(N_ERROR)
    s[DP] = -velocity_n
    return s


@kernel()
def regress(z, h, S, residual):  # type: ignore[no-untyped-def]
    """
    Regress an innovation on the clock offset.

    Parameters
    ----------
    z, h, S : ndarray, shape (m,), (m,), (m, m)
        Innovation, its sensitivity to the offset, and its covariance.
    residual : float
        Estimate of the offset so far [s].

    Returns
    -------
    information, gradient, nis : float
        With r = z - h residual: h' S^-1 h, h' S^-1 r, r' S^-1 r.
    """
    m = len(z)
    root, rest = S.copy(), z - h * residual
    factorise(root)
    weighted_h, weighted_rest = h.copy(), rest.copy()
    solve(root, weighted_h)
    solve(root, weighted_rest)
    information, gradient, nis = 0.0, 0.0, 0.0
    for a in range(m):
        information += h[a] * weighted_h[a]
        gradient += h[a] * weighted_rest[a]
        nis += rest[a] * weighted_rest[a]
    return information, gradient, nis
