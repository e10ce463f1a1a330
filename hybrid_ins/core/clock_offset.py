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

Receivers deliver velocities of another age than positions: their clock offset is tau + delta. The
filter has a sensitivity to delta likewise, u, and an innovation the mean h tau + g delta, where
g = H u, of a velocity H u + a. Without delta, velocities a tenth of a second older than positions
drew tau by 0.04 s on a simulated multirotor and by 0.15 s on a fixed wing.

The regression has three parameters, tau, its drift, and delta. Without information their variances
grow no larger than those of a clock of which nothing is known.

What is not known of tau is *considered*, [2]_: its variance V adds V h h' to the covariance of an
innovation that a fix is judged by, and V s s' to the covariance of the state that is reported.
While tau is estimated, the mean square of delta is part of R of velocities.

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
from hybrid_ins.core.linalg import factorise, whiten
from hybrid_ins.core.noise import Correction
from hybrid_ins.core.state import (
    ACCELERATION,
    AGE_SENSITIVITY,
    DP,
    N_ERROR,
    SENSITIVITY,
    VELOCITY,
)

Array = NDArray[np.float64]

RANDOM_WALK = 1e-4  # s per sqrt(s), of one clock against the other
DRIFT_STD, DRIFT_WALK = 1e-4, 1e-6  # s/s, and s/s per sqrt(s), likewise
MIN_STD = 1e-3  # s: stamps are no better than that
MAX_STD = 0.5  # s, of a clock of which nothing is known: fixes that come later are not fused
VELOCITY_AGE_STD = 0.1  # s, of a receiver's velocity against its position
AGE_TIME = 5.0  # s, in which it changes: receivers filter velocities, it follows the motion
MOTION_TIME = 0.5  # s, in which a motion changes: what a shift by a time t leaves wrong is t²/that
NIS_MEMORY = 40.0  # corrections over which the normalised NIS is averaged
MARGIN = 1.2  # factor on σ: innovations are not quite white. Without it, the largest error in a
# quarter of an hour of smooth driving with metre fixes was 3.1 and 3.4 σ


# The estimate as one flat vector, so that a compiled call has one argument and a checkpoint is one
# copy.
RESIDUAL, DRIFT, AGE = 0, 1, 2
N_PARAMETERS = 3
P_PARAMETERS = slice(3, 12)  # their covariance, row by row
P_RESIDUAL, P_DRIFT, P_AGE = 3, 7, 11  # its diagonal
NIS_SCALE = 12
N_CLOCK = 13


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
        Offset, drift and age of velocities by the innovations alone, their covariance, and the
        mean normalised NIS.
    """

    __slots__ = ("_t_ns", "prior", "values")

    def __init__(self, std: float, prior: ClockPrior | None = None) -> None:
        self.prior = prior
        self.values = np.zeros(N_CLOCK)
        self.values[P_RESIDUAL], self.values[P_DRIFT] = std**2, DRIFT_STD**2
        self.values[P_AGE] = VELOCITY_AGE_STD**2
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
        return math.sqrt(self.values.item(P_RESIDUAL) * variance_factor(self.values))

    @property
    def velocity_age(self) -> tuple[float, float]:
        """How much younger velocities are than positions with the same stamp, and its σ [s]."""
        variance = self.values.item(P_AGE) * variance_factor(self.values)
        return self.values.item(AGE), math.sqrt(variance)

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

    def update(self, correction: Correction, h: Array, S: Array) -> None:
        """
        Use a correction, or a fix that was rejected.

        Parameters
        ----------
        correction : Correction
            What the fix did to the state.
        h : ndarray, shape (m, 2)
            `sensitivities` of its innovation.
        S : ndarray, shape (m, m)
            Covariance of the innovation, with R as it was fused but for the age of a velocity.
        """
        since = self.interval(correction.t_ns)
        observe(self.values, since, correction.z, h, S, correction.fused)
        self.on_corrected(correction.t_ns)

    def on_corrected(self, t_ns: int) -> None:
        """Note that ``values`` contain a correction with this stamp [ns]."""
        self._t_ns = t_ns

    def set_estimate(self, residual: float, sigma: float) -> None:
        """Replace estimate and standard deviation [s] by those of a mixture of filters."""
        values = self.values
        values[RESIDUAL], values[DRIFT] = residual, 0.0
        P = values[P_PARAMETERS].reshape(N_PARAMETERS, N_PARAMETERS)
        P[:AGE], P[:, :AGE] = 0.0, 0.0
        values[P_RESIDUAL] = max(sigma**2 / variance_factor(values), MIN_STD**2)
        values[P_DRIFT] = DRIFT_STD**2

    def shift(self, by: float, nav: Array) -> Array:
        """
        Note that ``by`` [s] more is added from now on.

        Returns the error, shape (15,), that the flat state ``nav`` has because it was not.
        """
        self.values[RESIDUAL] -= by
        if self.prior is not None:
            self.prior = self.prior._replace(mean=self.prior.mean - by)
        self.values[P_RESIDUAL] += (by * min(abs(by) / MOTION_TIME, 1.0)) ** 2
        return np.asarray(by * nav[SENSITIVITY])


def initial_sensitivity(velocity_n: Array) -> Array:
    """Return the sensitivity, shape (15,), of a state that was read off the fixes."""
    s = np.zeros(N_ERROR)
    s[DP] = -velocity_n
    return s


@register_jitable
def variance_factor(clock):  # type: ignore[no-untyped-def]
    """Return the factor by which the variances in ``clock``, (N_CLOCK,), are too small."""
    return MARGIN**2 * max(clock[NIS_SCALE], 1.0)


@register_jitable
def age_mean_square(clock):  # type: ignore[no-untyped-def]
    """Return the mean square [s²] of the age of velocities."""
    return clock[AGE] ** 2 + clock[P_AGE] * variance_factor(clock)


@kernel()
def sensitivities(nav, H):  # type: ignore[no-untyped-def]
    """
    Return how an innovation of fixes changes with the clock offset and with the age of velocities.

    Parameters
    ----------
    nav : ndarray, shape (N_FLAT,)
        Flat state before the correction.
    H : ndarray, shape (m, 15)
        Measurement matrix.

    Returns
    -------
    h : ndarray, shape (m, 2)
        H s + v and H u of a position, H s + a and H u + a of a velocity.
    change : ndarray, shape (m,)
        a of a velocity: how it changes with its stamp.
    """
    m = H.shape[0]
    s, u = nav[SENSITIVITY], nav[AGE_SENSITIVITY]
    velocity, acceleration = nav[VELOCITY], nav[ACCELERATION]
    h, change = np.zeros((m, 2)), np.zeros(m)
    for a in range(m):
        for i in range(N_ERROR):
            h[a, 0] += H[a, i] * s[i]
            h[a, 1] += H[a, i] * u[i]
        for i in range(3):
            h[a, 0] += H[a, i] * velocity[i]
            change[a] += H[a, 3 + i] * acceleration[i]
        h[a, 0] += change[a]
        h[a, 1] += change[a]
    return h, change


@register_jitable
def predict(clock, interval):  # type: ignore[no-untyped-def]
    """Advance the parameters and their covariance by a time [s]."""
    P = clock[P_PARAMETERS].reshape(N_PARAMETERS, N_PARAMETERS)
    clock[RESIDUAL] += interval * clock[DRIFT]
    for j in range(N_PARAMETERS):
        P[RESIDUAL, j] += interval * P[DRIFT, j]
    for i in range(N_PARAMETERS):
        P[i, RESIDUAL] += interval * P[i, DRIFT]
    P[RESIDUAL, RESIDUAL] += RANDOM_WALK**2 * interval
    P[DRIFT, DRIFT] = min(P[DRIFT, DRIFT] + DRIFT_WALK**2 * interval, DRIFT_STD**2)
    left = np.exp(-interval / AGE_TIME)
    clock[AGE] *= left
    for i in range(N_PARAMETERS):
        P[AGE, i] *= left
        P[i, AGE] *= left
    P[AGE, AGE] += (1.0 - left**2) * VELOCITY_AGE_STD**2
    if P[RESIDUAL, RESIDUAL] > MAX_STD**2:  # correlations and the mean over sigma stay
        share = MAX_STD / np.sqrt(P[RESIDUAL, RESIDUAL])
        clock[RESIDUAL] *= share
        for i in range(N_PARAMETERS):
            P[RESIDUAL, i] *= share
            P[i, RESIDUAL] *= share


@kernel()
def observe(clock, interval, z, h, S, informs):  # type: ignore[no-untyped-def]
    """
    Take an innovation into account, by a Kalman filter of offset, drift and age.

    Parameters
    ----------
    clock : ndarray, shape (N_CLOCK,)
        `ClockOffsetObserver.values`; overwritten.
    interval : float
        Time since the last correction [s]; infinite without one.
    z, h, S : ndarray, shape (m,), (m, 2), (m, m)
        Innovation, its `sensitivities`, and its covariance.
    informs : bool
        The fix was fused.
    """
    if 0.0 < interval < np.inf:
        predict(clock, interval)
    if not informs:
        return
    P = clock[P_PARAMETERS].reshape(N_PARAMETERS, N_PARAMETERS)
    root, to_offset, to_age = S.copy(), h[:, 0].copy(), h[:, 1].copy()
    factorise(root)
    whiten(root, to_offset)
    whiten(root, to_age)
    rest = z - h[:, 0] * clock[RESIDUAL] - h[:, 1] * clock[AGE]
    nis, m = whiten(root, rest), len(z)
    clock[NIS_SCALE] += (nis / m - clock[NIS_SCALE]) / NIS_MEMORY
    before, now, g = clock[:N_PARAMETERS].copy(), clock[:N_PARAMETERS], np.empty(N_PARAMETERS)
    for a in range(m):
        missing = rest[a]
        missing -= to_offset[a] * (now[RESIDUAL] - before[RESIDUAL])
        missing -= to_age[a] * (now[AGE] - before[AGE])
        for i in range(N_PARAMETERS):
            g[i] = P[i, RESIDUAL] * to_offset[a] + P[i, AGE] * to_age[a]
        variance = 1.0 + to_offset[a] * g[RESIDUAL] + to_age[a] * g[AGE]
        for i in range(N_PARAMETERS):
            now[i] += g[i] * missing / variance
            for j in range(N_PARAMETERS):
                P[i, j] -= g[i] * (g[j] / variance)
    P[RESIDUAL, RESIDUAL] = max(P[RESIDUAL, RESIDUAL], MIN_STD**2)
    P[AGE, AGE] = max(P[AGE, AGE], MIN_STD**2)
