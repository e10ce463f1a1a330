"""
Clock offset of fixes, estimated beside the filter from its innovations.

A fix that was valid a time tau after its stamp leaves an innovation with the mean h tau, and a
velocity that is delta younger than the position with the same stamp one of h tau + g delta
(`clock_sensitivity`). Regressing the innovations on h and g is what a filter with tau and delta
among its states would do; the filter itself is not changed by it. Without delta, velocities a tenth
of a second older than positions drew tau by 0.04 s on a simulated multirotor and by 0.15 s on a
fixed wing.

Where a vehicle cruises with precise fixes and a shaken IMU, h is mostly noise of the INS velocity,
and the regression would find a tau near zero with far too small a sigma, [1]_. So h counts by the
share of motion in the information of late, which makes it the mean of the true h given the noisy
one; see `clock_sensitivity.noise_information`.

The regression has three parameters, tau, its drift, and delta. Without information their variances
grow no larger than those of a clock of which nothing is known.

What is not known of tau is *considered*, [2]_: its variance V adds V h h' to the covariance of an
innovation that a fix is judged by, and V s s' to the covariance of the state that is reported.
While tau is estimated, the mean square of delta is part of R of velocities.

References
----------
.. [1] W. A. Fuller, *Measurement Error Models*, 1987, sections 1.1 and 1.2 (attenuation).
.. [2] S. F. Schmidt, "Application of state-space methods to navigation problems", Advances in
       Control Systems 3, 1966.
"""

from __future__ import annotations

import math

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.inertial.state import SENSITIVITY
from hybrid_ins.core.noise.motion_share import fade_sums, motion_share
from hybrid_ins.core.noise.process_noise import Correction
from hybrid_ins.core.sensor_errors.clock_prior import UNKNOWN_DRIFT, ClockDrift, ClockPrior
from hybrid_ins.core.update.linalg import factorise, whiten

Array = NDArray[np.float64]

RANDOM_WALK = 1e-4  # s per sqrt(s), of one clock against the other
DRIFT_WALK = 1e-6  # s/s per sqrt(s), likewise
MIN_STD = 1e-3  # s: stamps are no better than that
MAX_STD = 0.5  # s, of a clock of which nothing is known: fixes that come later are not fused
VELOCITY_AGE_STD = 0.1  # s, of a receiver's velocity against its position, until more is known
LARGEST_AGE_STD = 1.0  # s
AGE_TIME = 5.0  # s, in which it changes: receivers filter velocities, it follows the motion
AGE_MEMORY = 20.0  # s, over which its mean square is averaged
MOTION_TIME = 0.5  # s, in which a motion changes: what a shift by a time t leaves wrong is t²/that
NIS_MEMORY = 40.0  # corrections over which the normalised NIS is averaged
LARGEST_INFORMATION = 1e30  # 1/s², of a fix: beyond it rounding leaves nothing of the covariance
MARGIN = 1.25  # factor on σ: innovations are not quite white. Without it, the largest error in a
# quarter of an hour of smooth driving with metre fixes was 3.1 to 3.6 σ


# The estimate as one flat vector, so that a compiled call has one argument and a checkpoint is one
# copy.
RESIDUAL, DRIFT, AGE = 0, 1, 2
N_PARAMETERS = 3
P_PARAMETERS = slice(3, 12)  # their covariance, row by row
P_RESIDUAL, P_DRIFT, P_AGE = 3, 7, 11  # its diagonal
NIS_SCALE = 12
INFORMATION, OF_NOISE = 13, 14  # of late, and the part of it that is noise of the IMU
SUMS = slice(INFORMATION, OF_NOISE + 1)  # see `motion_share`
DRIFT_VARIANCE = 15  # of the prior: walks lead no further from it
AGE_VARIANCE = 16  # of the age, of which the estimate is one of many
N_CLOCK = 17


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
    drift : ClockDrift, optional
        Of the offset.

    Attributes
    ----------
    prior : ClockPrior or None
        What is known of the offset without innovations.
    values : ndarray, shape (N_CLOCK,)
        Offset, drift and age of velocities by the innovations alone, their covariance, and the
        mean normalised NIS.
    """

    __slots__ = ("_drift", "_start_ns", "_t_ns", "prior", "values")

    def __init__(
        self,
        std: float,
        prior: ClockPrior | None = None,
        drift: ClockDrift = UNKNOWN_DRIFT,
    ) -> None:
        self.prior = prior
        self._drift = drift
        self.values = np.zeros(N_CLOCK)
        self.values[DRIFT], self.values[DRIFT_VARIANCE] = drift.mean, drift.std**2
        self.values[P_RESIDUAL], self.values[P_DRIFT] = std**2, drift.std**2
        self.values[P_AGE] = self.values[AGE_VARIANCE] = VELOCITY_AGE_STD**2
        self.values[NIS_SCALE] = 1.0
        self._start_ns = self._t_ns = 0  # of the first and the last correction

    def __copy__(self) -> ClockOffsetObserver:
        twin = object.__new__(ClockOffsetObserver)
        twin.values, twin.prior, twin._drift = self.values.copy(), self.prior, self._drift
        twin._start_ns, twin._t_ns = self._start_ns, self._t_ns
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
    def drift_sigma(self) -> float:
        """Standard deviation of `drift` [s/s]."""
        return math.sqrt(self.values.item(P_DRIFT) * variance_factor(self.values))

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
        # The prior is that of a start, a line back from now but for the walks since.
        values, age = self.values, (self._t_ns - (self.prior.t_ns or self._start_ns)) * 1e-9
        factor = variance_factor(values)
        with_drift = factor * values.item(P_RESIDUAL + DRIFT)
        of_drift = factor * values.item(P_DRIFT)
        walked = abs(age) * (RANDOM_WALK**2 + (age * DRIFT_WALK) ** 2 / 3.0)
        mean, variance = self.prior.posterior(
            self.residual,
            variance,
            self.residual - age * values.item(DRIFT),
            max(variance - 2.0 * age * with_drift + age**2 * of_drift, 0.0) + walked,
            variance - age * with_drift,
        )
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

    def update(self, correction: Correction, h: Array, S: Array, of_noise: float) -> None:
        """
        Use a correction, or a fix that was rejected.

        Parameters
        ----------
        correction : Correction
            What the fix did to the state.
        h : ndarray, shape (m, 2)
            `clock_sensitivity.sensitivities` of its innovation.
        S : ndarray, shape (m, m)
            Covariance of the innovation, with R as it was fused but for the age of a velocity.
        of_noise : float
            `clock_sensitivity.noise_information`.
        """
        since = self.interval(correction.t_ns)
        observe(self.values, since, correction.z, h, S, of_noise, correction.fused)
        self.on_corrected(correction.t_ns)

    def on_corrected(self, t_ns: int) -> None:
        """Note that ``values`` contain a correction with this stamp [ns]."""
        self._start_ns = self._start_ns or t_ns
        self._t_ns = t_ns

    def set_estimate(self, residual: float, sigma: float) -> None:
        """Replace estimate and standard deviation [s] by those of a mixture of filters."""
        values = self.values
        values[RESIDUAL], values[DRIFT] = residual, self._drift.mean
        P = values[P_PARAMETERS].reshape(N_PARAMETERS, N_PARAMETERS)
        P[:AGE], P[:, :AGE] = 0.0, 0.0
        values[P_RESIDUAL] = max(sigma**2 / variance_factor(values), MIN_STD**2)
        values[P_DRIFT] = self._drift.std**2

    def inflate(self, std: float) -> None:
        """Allow for a change of the clock by ``std`` [s]."""
        self.values[P_RESIDUAL] += std**2 / variance_factor(self.values)

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


@register_jitable
def variance_factor(clock):  # type: ignore[no-untyped-def]
    """Return the factor by which the variances in ``clock``, (N_CLOCK,), are too small."""
    return MARGIN**2 * max(clock[NIS_SCALE], 1.0)


@register_jitable
def share_of_motion(clock):  # type: ignore[no-untyped-def]
    """Return the share of the late information that is of motion, not of noise."""
    return motion_share(clock[SUMS])


@register_jitable
def age_mean_square(clock):  # type: ignore[no-untyped-def]
    """Return the mean square [s²] of the age of velocities."""
    return clock[AGE] ** 2 + clock[P_AGE] * variance_factor(clock)


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
    P[DRIFT, DRIFT] = min(P[DRIFT, DRIFT] + DRIFT_WALK**2 * interval, clock[DRIFT_VARIANCE])
    fade_sums(clock[SUMS], interval)
    towards = 1.0 - np.exp(-interval / AGE_MEMORY)
    variance = clock[AGE_VARIANCE] + towards * (age_mean_square(clock) - clock[AGE_VARIANCE])
    clock[AGE_VARIANCE] = min(max(variance, VELOCITY_AGE_STD**2), LARGEST_AGE_STD**2)
    left = np.exp(-interval / AGE_TIME)
    clock[AGE] *= left
    for i in range(N_PARAMETERS):
        P[AGE, i] *= left
        P[i, AGE] *= left
    P[AGE, AGE] += (1.0 - left**2) * clock[AGE_VARIANCE]
    if P[RESIDUAL, RESIDUAL] > MAX_STD**2:  # correlations and the mean over sigma stay
        share = MAX_STD / np.sqrt(P[RESIDUAL, RESIDUAL])
        clock[RESIDUAL] *= share
        for i in range(N_PARAMETERS):
            P[RESIDUAL, i] *= share
            P[i, RESIDUAL] *= share


@kernel()
def observe(clock, interval, z, h, S, of_noise, informs):  # type: ignore[no-untyped-def]
    """
    Take an innovation into account, by a Kalman filter of offset, drift and age.

    Parameters
    ----------
    clock : ndarray, shape (N_CLOCK,)
        `ClockOffsetObserver.values`; overwritten.
    interval : float
        Time since the last correction [s]; infinite without one.
    z, h, S : ndarray, shape (m,), (m, 2), (m, m)
        Innovation, its `clock_sensitivity.sensitivities`, and its covariance.
    of_noise : float
        Its `clock_sensitivity.noise_information`.
    informs : bool
        The fix was fused.
    """
    if 0.0 < interval < np.inf:
        predict(clock, interval)
    if not informs:
        return
    P = clock[P_PARAMETERS].reshape(N_PARAMETERS, N_PARAMETERS)
    root, to_offset, to_age, rest = S.copy(), h[:, 0].copy(), h[:, 1].copy(), z.copy()
    factorise(root)
    information = whiten(root, to_offset)
    if not information < LARGEST_INFORMATION:
        return
    clock[INFORMATION] += information
    clock[OF_NOISE] += of_noise
    whiten(root, to_age)
    whiten(root, rest)
    share = share_of_motion(clock)
    nis, m, now, g = 0.0, len(z), clock[:N_PARAMETERS], np.empty(N_PARAMETERS)
    for a in range(m):
        to_offset[a] *= share
        to_age[a] *= share
        nis += (rest[a] - to_offset[a] * now[RESIDUAL] - to_age[a] * now[AGE]) ** 2
    clock[NIS_SCALE] += (nis / m - clock[NIS_SCALE]) / NIS_MEMORY
    for a in range(m):
        missing = rest[a] - to_offset[a] * now[RESIDUAL] - to_age[a] * now[AGE]
        for i in range(N_PARAMETERS):
            g[i] = P[i, RESIDUAL] * to_offset[a] + P[i, AGE] * to_age[a]
        variance = 1.0 + to_offset[a] * g[RESIDUAL] + to_age[a] * g[AGE]
        for i in range(N_PARAMETERS):
            now[i] += g[i] * missing / variance
            for j in range(N_PARAMETERS):
                P[i, j] -= g[i] * (g[j] / variance)
    P[RESIDUAL, RESIDUAL] = max(P[RESIDUAL, RESIDUAL], MIN_STD**2)
    P[AGE, AGE] = max(P[AGE, AGE], MIN_STD**2)
