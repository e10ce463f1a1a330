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
has two parameters, tau and its drift, of which innovations show the first. Without information
their variances grow no larger than those of a clock of which nothing is known.

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
from numba.extending import register_jitable
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
MAX_STD = 0.5  # s, of a clock of which nothing is known: fixes that come later are not fused
VELOCITY_AGE_STD = 0.1  # s, of a receiver's velocity against its position
MOTION_TIME = 0.5  # s, in which a motion changes: what a shift by a time t leaves wrong is t²/that
MIN_INTERVAL, MAX_INTERVAL = 0.02, 60.0  # s, over which a mean acceleration is meaningful
NIS_MEMORY = 40.0  # corrections over which the normalised NIS is averaged
MARGIN = 1.2  # factor on σ: innovations are not quite white. Without it, the largest error in a
# quarter of an hour of smooth driving with metre fixes was 3.1 and 3.4 σ


# The estimate as one flat vector, so that a compiled call has one argument and a checkpoint is one
# copy.
RESIDUAL, DRIFT = 0, 1
P_OFFSET, P_CROSS, P_DRIFT = 2, 3, 4  # covariance of offset and drift
NIS_SCALE = 5
LAST_VELOCITY = slice(6, 9)  # NED, after the last correction
ACCELERATION = slice(9, 12)  # NED, mean before it
N_CLOCK = 12


class ClockOffsetObserver:
    """
    Estimates the offset that is still to be added to the stamps of fixes.

    A copy is a checkpoint.

    Parameters
    ----------
    std : float
        Standard deviation at the start [s].
    prior : ClockPrior, optional
        Of the offset; without one, all within ``std`` are equally likely.

    Attributes
    ----------
    prior : ClockPrior or None
        What is known of the offset without innovations.
    values : ndarray, shape (N_CLOCK,)
        Offset and drift by the innovations alone, their covariance, and what the next correction is
        compared with.
    """

    __slots__ = ("_t_ns", "prior", "values")

    def __init__(self, std: float, prior: ClockPrior | None = None) -> None:
        self.prior = prior
        self.values = np.zeros(N_CLOCK)
        self.values[P_OFFSET], self.values[P_DRIFT] = std**2, DRIFT_STD**2
        self.values[NIS_SCALE] = 1.0
        self._t_ns = 0  # of the last correction

    def __copy__(self) -> ClockOffsetObserver:
        twin = object.__new__(ClockOffsetObserver)
        twin.values, twin._t_ns, twin.prior = self.values.copy(), self._t_ns, self.prior
        return twin

    @property
    def residual(self) -> float:
        """Offset still to be added to the stamps of fixes, by the innovations alone [s]."""
        return self.values.item(RESIDUAL)

    @property
    def drift(self) -> float:
        """Rate of change of `residual` [s/s]."""
        return float(self.values[DRIFT])

    @property
    def sigma(self) -> float:
        """Standard deviation of `residual` [s]."""
        return MARGIN * math.sqrt(
            self.values.item(P_OFFSET) * max(self.values.item(NIS_SCALE), 1.0)
        )

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

    def interval(self, t_ns: int) -> float:
        """Return the time from the last correction to a stamp [s]; infinite without one."""
        return (t_ns - self._t_ns) * 1e-9 if self._t_ns else math.inf

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
        h, _ = sensitivities(nav, self.values, self.interval(t_ns), H)
        return np.asarray(h)

    def velocity_age_covariance(self, nav: Array, t_ns: int, H: Array) -> Array:
        """Return what the unknown age of a velocity adds to its R, (m, m); see `sensitivity_of`."""
        _, change = sensitivities(nav, self.values, self.interval(t_ns), H)
        return VELOCITY_AGE_STD**2 * np.outer(change, change)

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
        velocity_n, informs = correction.nav[VELOCITY], correction.fused and informs
        since = self.interval(correction.t_ns)
        observe(self.values, since, velocity_n, correction.dx, correction.z, h, S, informs)
        self.on_corrected(correction.t_ns)

    def on_corrected(self, t_ns: int) -> None:
        """Note that ``values`` contain a correction with this stamp [ns]."""
        self._t_ns = t_ns

    def set_estimate(self, residual: float, sigma: float) -> None:
        """Replace estimate and standard deviation [s] by those of a mixture of filters."""
        values = self.values
        variance = (sigma / MARGIN) ** 2 / max(float(values[NIS_SCALE]), 1.0)
        values[RESIDUAL], values[DRIFT] = residual, 0.0
        values[P_OFFSET] = max(variance, MIN_STD**2)
        values[P_CROSS], values[P_DRIFT] = 0.0, DRIFT_STD**2

    def shift(self, by: float, nav: Array) -> Array:
        """
        Note that ``by`` [s] more is added from now on.

        Returns the error, shape (15,), that the flat state ``nav`` has because it was not.
        """
        self.values[RESIDUAL] -= by
        if self.prior is not None:
            self.prior = self.prior._replace(mean=self.prior.mean - by)
        self.values[P_OFFSET] += (by * min(abs(by) / MOTION_TIME, 1.0)) ** 2
        moved = by * nav[SENSITIVITY]
        self.values[LAST_VELOCITY] += moved[DV]
        return np.asarray(moved)

    def on_moved_state(self, velocity_n: Array) -> None:
        """Note that the state was changed by other means than a correction."""
        self.values[LAST_VELOCITY] = velocity_n


def initial_sensitivity(velocity_n: Array) -> Array:
    """Return the sensitivity, shape (15,), of a state that was read off the fixes."""
    s = np.zeros(N_ERROR)
    s[DP] = -velocity_n
    return s


@register_jitable
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


@register_jitable
def write_mean_acceleration(velocity_n, clock, interval, out):  # type: ignore[no-untyped-def]
    """Write the acceleration (3,) [m/s²], NED, of the time since the last correction."""
    last, acceleration = clock[LAST_VELOCITY], clock[ACCELERATION]
    for i in range(3):
        if 0.0 <= interval < MIN_INTERVAL:
            out[i] = acceleration[i]
        elif 0.0 < interval <= MAX_INTERVAL:
            out[i] = (velocity_n[i] - last[i]) / interval
        else:
            out[i] = 0.0


@kernel()
def sensitivities(nav, clock, interval, H):  # type: ignore[no-untyped-def]
    """
    Return how an innovation of fixes changes with the clock offset.

    Parameters
    ----------
    nav : ndarray, shape (N_FLAT,)
        Flat state before the correction.
    clock : ndarray, shape (N_CLOCK,)
        `ClockOffsetObserver.values`.
    interval : float
        Time since the last correction [s].
    H : ndarray, shape (m, 15)
        Measurement matrix.

    Returns
    -------
    h, change : ndarray, shape (m,)
        H s + v or H s + a; and the part of it by which a measured velocity changes with its stamp.
    """
    m = H.shape[0]
    s, velocity, acceleration = nav[SENSITIVITY], nav[VELOCITY], np.empty(3)
    write_mean_acceleration(velocity, clock, interval, acceleration)
    h, change = np.zeros(m), np.zeros(m)
    for a in range(m):
        for i in range(N_ERROR):
            h[a] += H[a, i] * s[i]
        for i in range(3):
            h[a] += H[a, i] * velocity[i]
            change[a] += H[a, 3 + i] * acceleration[i]
        h[a] += change[a]
    return h, change


@kernel()
def observe(clock, interval, velocity_n, dx, z, h, S, informs):  # type: ignore[no-untyped-def]
    """
    Take a correction into account, by a Kalman filter of offset and drift.

    Parameters
    ----------
    clock : ndarray, shape (N_CLOCK,)
        `ClockOffsetObserver.values`; overwritten.
    interval : float
        Time since the last correction [s]; infinite without one.
    velocity_n, dx : ndarray, shape (3,), (15,)
        Velocity before the correction [m/s], and the correction of the state.
    z, h, S, informs
        See `ClockOffsetObserver.update`.
    """
    if 0.0 < interval < np.inf:
        cross = clock[P_CROSS] + interval * clock[P_DRIFT]
        clock[RESIDUAL] += interval * clock[DRIFT]
        clock[P_OFFSET] += interval * (clock[P_CROSS] + cross) + RANDOM_WALK**2 * interval
        clock[P_CROSS] = cross
        clock[P_DRIFT] = min(clock[P_DRIFT] + DRIFT_WALK**2 * interval, DRIFT_STD**2)
        if clock[P_OFFSET] > MAX_STD**2:  # correlation with the drift and mean over sigma stay
            share = MAX_STD / np.sqrt(clock[P_OFFSET])
            clock[RESIDUAL] *= share
            clock[P_CROSS] *= share
            clock[P_OFFSET] = MAX_STD**2
    acceleration = np.empty(3)
    write_mean_acceleration(velocity_n, clock, interval, acceleration)
    for i in range(3):
        clock[ACCELERATION][i] = acceleration[i]
        clock[LAST_VELOCITY][i] = velocity_n[i] + dx[3 + i]
    if not informs:
        return
    information, gradient, nis = regress(z, h, S, clock[RESIDUAL])
    clock[NIS_SCALE] += (nis / len(z) - clock[NIS_SCALE]) / NIS_MEMORY
    variance, cross = clock[P_OFFSET], clock[P_CROSS]
    gain = variance / (1.0 + variance * information)
    gain_drift = cross / (1.0 + variance * information)
    clock[RESIDUAL] += gain * gradient
    clock[DRIFT] += gain_drift * gradient
    clock[P_OFFSET] = max(variance - information * gain * variance, MIN_STD**2)
    clock[P_CROSS] = cross - information * gain * cross
    clock[P_DRIFT] -= information * gain_drift * cross
