"""
Clock offset of fixes, estimated beside the filter from its innovations.

A fix that was valid a time tau after its stamp is displaced by v tau. The filter follows part of
that: its state has the error s tau, and an innovation the mean h tau with h = H s + v (of a
velocity: H s + a). For the filter tau is a constant, so its sensitivity s = d(error)/d(tau) obeys
the filter's own equations, [1]_::

    s <- Phi s              with every step of the covariance (`propagation`)
    s <- s - K h            with every correction, h = H s where the measurement has no clock

The s that these give is as stable as the filter is. Regressing the innovations on h is what a
filter with tau among its states would do; the filter itself is not changed by it. The regression
has two parameters, tau and its drift, of which innovations show the first.

What is not known of tau is *considered*, [2]_: its variance V adds V h h' to the covariance of an
innovation that a fix is judged by, and V s s' to the covariance of the state that is reported.

Only positions inform tau: receivers deliver velocities of another age, whose uncertainty is part
of their R while tau is estimated.

References
----------
.. [1] B. Friedland, "Treatment of bias in recursive filtering", IEEE Transactions on Automatic
       Control 14, 1969.
.. [2] S. F. Schmidt, "Application of state-space methods to navigation problems", Advances in
       Control Systems 3, 1966.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.clock_prior import ClockPrior
from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.linalg import factorise, solve
from hybrid_ins.core.noise import Correction
from hybrid_ins.core.state import DP, DV, N_ERROR, SENSITIVITY, VELOCITY

Array = NDArray[np.float64]

RANDOM_WALK = 1e-4  # s per sqrt(s), of one clock against the other
DRIFT_STD, DRIFT_WALK = 1e-4, 1e-6  # s/s, and s/s per sqrt(s), likewise
MIN_STD = 1e-3  # s: stamps are no better than that
VELOCITY_AGE_STD = 0.1  # s, of a receiver's velocity against its position
MOTION_TIME = 0.5  # s, in which a motion changes: what a shift by a time t leaves wrong is t²/that
MIN_INTERVAL, MAX_INTERVAL = 0.02, 60.0  # s, over which a mean acceleration is meaningful
NIS_MEMORY = 40.0  # corrections over which the normalised NIS is averaged
MARGIN = 1.2  # factor on σ: innovations are not quite white. Without it, the largest error in a
# quarter of an hour of smooth driving with metre fixes was 3.1 and 3.4 σ


class ClockOffsetObserver:
    """
    Estimates the offset that is still to be added to the stamps of fixes.

    Arrays are replaced, never changed in place: a shallow copy is a checkpoint.

    Parameters
    ----------
    std : float
        Standard deviation at the start [s].
    prior : ClockPrior, optional
        Of the offset; without one, all within ``std`` are equally likely.

    Attributes
    ----------
    residual : float
        Offset still to be added to the stamps of fixes, by the innovations alone [s].
    drift : float
        Its rate of change [s/s].
    """

    def __init__(self, std: float, prior: ClockPrior | None = None) -> None:
        self.prior = prior
        self.residual = 0.0
        self.drift = 0.0
        self._P = np.diag((std**2, DRIFT_STD**2))  # of offset and drift
        self._nis_scale = 1.0
        self._t_ns = 0  # of the last correction
        self._velocity_n = np.zeros(3)  # after it
        self._acceleration_n = np.zeros(3)  # mean before it

    @property
    def sigma(self) -> float:
        """Standard deviation of `residual` [s]."""
        return MARGIN * math.sqrt(float(self._P[0, 0]) * max(self._nis_scale, 1.0))

    @property
    def missing(self) -> tuple[float, float]:
        """Offset still to be added [s] by innovations and prior, and its variance [s²]."""
        variance = self.sigma**2
        if self.prior is None:
            return self.residual, variance
        mean, variance = self.prior.posterior(self.residual, variance)
        return mean, max(variance, MIN_STD**2)

    @property
    def contradiction(self) -> float:
        """Distance between the innovations' offset and the given one, in standard deviations."""
        given = 0.0 if self.prior is None else self.prior.mean
        return abs(self.residual - given) / self.sigma

    @property
    def missing_variance(self) -> float:
        """Mean square of what the stamps of fixes lack [s²]."""
        mean, variance = self.missing
        return variance + mean**2

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
        return np.asarray(
            H @ nav[SENSITIVITY] + H[:, DP] @ nav[VELOCITY] + self._change_of_velocity(nav, t_ns, H)
        )

    def velocity_age_covariance(self, nav: Array, t_ns: int, H: Array) -> Array:
        """Return what the unknown age of a velocity adds to its R, (m, m); see `sensitivity_of`."""
        change = VELOCITY_AGE_STD * self._change_of_velocity(nav, t_ns, H)
        return np.outer(change, change)

    def _change_of_velocity(self, nav: Array, t_ns: int, H: Array) -> Array:
        """Return how a measured velocity changes with its stamp, shape (m,)."""
        return np.asarray(H[:, DV] @ self._mean_acceleration(nav, t_ns))

    def _mean_acceleration(self, nav: Array, t_ns: int) -> Array:
        """Return the acceleration of the time since the last correction [m/s²], NED."""
        T = (t_ns - self._t_ns) * 1e-9
        if 0.0 <= T < MIN_INTERVAL:
            return self._acceleration_n
        if not 0.0 < T <= MAX_INTERVAL:
            return np.zeros(3)
        return np.asarray((nav[VELOCITY] - self._velocity_n) / T)

    def update(self, correction: Correction, h: Array, S: Array, informs: bool = True) -> None:
        """
        Use a correction, or a fix that was rejected.

        Parameters
        ----------
        correction : Correction
            What the fix did to the state.
        h : ndarray, shape (m,)
            `sensitivity_of` its innovation.
        S : ndarray, shape (m, m)
            Covariance of the innovation, with R as it was fused.
        informs : bool
            The fix has the clock whose offset is estimated.
        """
        T = (correction.t_ns - self._t_ns) * 1e-9
        if self._t_ns and T > 0.0:
            self._predict(T)
        self._acceleration_n = self._mean_acceleration(correction.nav, correction.t_ns)
        if correction.fused and informs:
            information, gradient, nis = regress(correction.z, h, S, self.residual)
            self._nis_scale += (nis / len(correction.z) - self._nis_scale) / NIS_MEMORY
            gain = self._P[:, 0] / (1.0 + self._P[0, 0] * information)
            self.residual += float(gain[0]) * gradient
            self.drift += float(gain[1]) * gradient
            self._P = self._P - information * np.outer(gain, self._P[0])
            self._set_variance(float(self._P[0, 0]))
        self._t_ns = correction.t_ns
        self._velocity_n = correction.nav[VELOCITY] + correction.dx[DV]

    def _predict(self, T: float) -> None:
        """Propagate offset and drift by a time [s]."""
        F = np.array([[1.0, T], [0.0, 1.0]])
        self.residual += T * self.drift
        self._P = F @ self._P @ F.T + np.diag((RANDOM_WALK**2 * T, DRIFT_WALK**2 * T))

    def _set_variance(self, variance: float) -> None:
        """Replace the offset's variance [s²], bounded from below."""
        added = max(variance, MIN_STD**2) - self._P[0, 0]
        self._P = self._P + np.diag((added, 0.0))

    def set_estimate(self, residual: float, sigma: float) -> None:
        """Replace estimate and standard deviation [s] by those of a mixture of filters."""
        self.residual, self.drift = residual, 0.0
        self._P = np.diag((0.0, DRIFT_STD**2))
        self._set_variance((sigma / MARGIN) ** 2 / max(self._nis_scale, 1.0))

    def shift(self, by: float, nav: Array) -> Array:
        """
        Note that ``by`` [s] more is added from now on.

        Returns the error, shape (15,), that the flat state ``nav`` has because it was not.
        """
        self.residual -= by
        if self.prior is not None:
            self.prior = self.prior._replace(mean=self.prior.mean - by)
        left = by * min(abs(by) / MOTION_TIME, 1.0)
        self._P = self._P + np.diag((left**2, 0.0))
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
