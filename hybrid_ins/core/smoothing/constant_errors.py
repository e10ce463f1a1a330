"""
What is constant and not known of a GNSS receiver, estimated by a smoother.

It is the lever arm of the antenna, where nobody gave it or where it has a standard deviation, and
what the clock offset of the fixes still lacks. The filter runs with assumed ones. What is missing
of them, c, is small, so that the errors of all states are linear in it: e = s c + (what they were
without), [1]_. The forward sensitivity s moves with the transition matrices and the gains; each
innovation, whose own sensitivity is h = H s + D, adds information about c. The smoothed states
have the sensitivity
s - P m, where the adjoint m takes h in as lambda takes the innovation in. What remains unknown of
c adds s V s' to their covariance, [2]_. Where nobody gave the lever arm that is the covariance of
the antenna's position, which the fixes measure; else a state that begins with a fix has s = -C_nb.
As in the filter a lever arm that is given is not moved, since it says what the odometry is of: what
is found of its error is considered with what is not known.

Both are estimated at once: on a straight way at a steady speed one is like the other, and on other
ways each would be drawn by the other. Most clocks are right: what the innovations say of the offset
is weighed against a `ClockPrior`, and the lever arm follows. Noise of a shaken IMU is no evidence
on the clock: as in `clock_offset` its regressor counts by the share of motion.

References
----------
.. [1] B. Friedland, "Treatment of bias in recursive filtering", IEEE Transactions on Automatic
       Control 14, 1969.
.. [2] S. F. Schmidt, "Application of state-space methods to navigation problems", Advances in
       Control Systems 3, 1966.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.inertial.rotations import matrix_from_quat
from hybrid_ins.core.inertial.state import (
    ACCELERATION,
    COVARIANCE,
    DP,
    DV,
    N_ERROR,
    PACKED_COLUMNS,
    PACKED_ROWS,
    QUAT,
    VELOCITY,
    NavState,
    covariance,
)
from hybrid_ins.core.noise.motion_share import fade_sums, motion_share
from hybrid_ins.core.sensor_errors.clock_offset import MAX_STD
from hybrid_ins.core.sensor_errors.clock_prior import ClockPrior
from hybrid_ins.core.sensor_errors.clock_sensitivity import noise_information
from hybrid_ins.core.smoothing.segments import Update
from hybrid_ins.core.update.measurements import Measurement, PositionFix, VelocityFix

Array = NDArray[np.float64]
Fix = PositionFix | VelocityFix  # of the antenna

LEVER, CLOCK = slice(0, 3), 3
N_CONSTANTS = 4
LEVER_STD = 0.5  # m, of each component before anything is measured
SETTLED = 0.1  # standard deviations by which the last pass may still have moved them
MOST_PASSES = 5
N_SENSITIVITY = N_CONSTANTS * N_ERROR
_STEP = 1e-3  # m, of the differences; the innovation is linear in the lever arm


class ConstantErrors:
    """
    Estimate of the antenna's position relative to the IMU and of the clock offset of fixes.

    It takes several passes of a smoother.

    Parameters
    ----------
    lever_std : ndarray, shape (3,), optional
        Of the lever arm that is given [m], b; 0: exact. None: nobody gave it.
    clock : ClockPrior, optional
        Of what the clock offset lacks, which is estimated then.

    Attributes
    ----------
    values : ndarray, shape (4,)
        Assumed in this pass: lever arm [m], b, and what is added to the stamps of fixes [s].
    covariance : ndarray, shape (4, 4)
        Of their errors, after a pass.
    sensitivity : ndarray, shape (15, 4)
        Of the forward state's error to what is missing.
    are_of_antenna : bool
        So are smoothed positions, whose lever arm nobody gave; else they are of the IMU.
    """

    def __init__(self, lever_std: Array | None, clock: ClockPrior | None) -> None:
        self.are_of_antenna = lever_std is None
        lever = np.full(3, LEVER_STD) if lever_std is None else lever_std
        self.values = np.zeros(N_CONSTANTS)
        self.covariance = np.zeros((N_CONSTANTS, N_CONSTANTS))
        self._clock = clock
        std = np.array([*lever, 0.0 if clock is None else MAX_STD])
        self._unknown = np.flatnonzero(std)
        self._std = std[self._unknown]

    @property
    def are_known(self) -> bool:
        """Nothing is estimated."""
        return not len(self._unknown)

    @property
    def lever_b(self) -> Array:
        """The antenna's position relative to the IMU beyond what was given [m], b."""
        return self.values[LEVER]

    @property
    def clock_offset(self) -> float:
        """What is to be added to the stamps of fixes [s]."""
        return self.values.item(CLOCK)

    def begin(self, start: NavState) -> None:
        """Begin a pass with a state that begins with a fix."""
        self.begin_sensitivity(start)
        self._information = np.zeros((N_CONSTANTS, N_CONSTANTS))
        self._gradient = np.zeros(N_CONSTANTS)
        self._sums, self._fixed_ns = np.zeros(2), 0  # see `motion_share`; of the last fix
        self.begin_adjoint()

    def begin_sensitivity(self, start: NavState) -> None:
        """Let ``sensitivity`` be that of the start."""
        self.sensitivity = np.zeros((N_ERROR, N_CONSTANTS))
        if not self.are_of_antenna:
            self.sensitivity[DP, LEVER] = -matrix_from_quat(start.quat_xyzw)

    def begin_adjoint(self) -> None:
        """Begin the backward part of a pass."""
        self._adjoint = np.zeros((N_ERROR, N_CONSTANTS))

    def assumed(self, update: Update) -> Update:
        """Return an update with the constants of this pass, where its measurement has them."""
        fix = update.measurement
        if not isinstance(fix, Fix):
            return update
        t_ns = fix.t_ns + round(self.clock_offset * 1e9)
        return replace(update, t_ns=t_ns, measurement=replace(_moved(fix, self.lever_b), t_ns=t_ns))

    def propagate(self, F: Array, lengths: Array) -> None:
        """Propagate the sensitivity over covariance steps: (m, 225), (m,) [s]."""
        for A, length in zip(F.reshape(-1, N_ERROR, N_ERROR), lengths.tolist(), strict=True):
            self.sensitivity = self.sensitivity + length * (A @ self.sensitivity)

    def correct(self, measurement: Measurement, before: Array, K: Array, R: Array) -> None:
        """
        Add a measurement's information on the constants; correct the sensitivity by its gain.

        Parameters
        ----------
        measurement : Measurement
            As it is `assumed` in this pass.
        before : ndarray, shape (N_FLAT,)
            Flat state before it.
        K, R : ndarray, shape (15, m), (m, m)
            Gain, and the covariance with which it was fused.
        """
        z, H, h = self._linearised(measurement, before)
        self.sensitivity = self.sensitivity - K @ h
        S = H @ covariance(before) @ H.T + R
        weighted = np.linalg.solve(S, h)
        if isinstance(measurement, Fix):
            of_noise = noise_information(before, H, K, S, isinstance(measurement, PositionFix))
            information = float(h[:, CLOCK] @ weighted[:, CLOCK])
            share = self._share_of_motion(measurement.t_ns, information, of_noise)
            h[:, CLOCK] *= share
            weighted[:, CLOCK] *= share
        self._information += weighted.T @ h
        self._gradient += weighted.T @ z

    def _share_of_motion(self, t_ns: int, information: float, of_noise: float) -> float:
        """Return it in what fixes of late say of the clock, with that of one at a stamp [ns]."""
        fade_sums(self._sums, (t_ns - self._fixed_ns) * 1e-9)
        self._sums += information, of_noise
        self._fixed_ns = t_ns
        return float(motion_share(self._sums))

    def turn(self, T: Array) -> None:
        """Turn the sensitivity with the errors: see `kalman.turn_errors`."""
        self.sensitivity = T @ self.sensitivity

    def turn_adjoint(self, T: Array) -> None:
        """Carry the adjoint back through `turn`."""
        self._adjoint = T.T @ self._adjoint

    def finish(self) -> bool:
        """Move the constants after the forward part; return whether they had settled before."""
        unknown, before = self._unknown, self.values[self._unknown]
        information = self._information[np.ix_(unknown, unknown)] + np.diag(self._std**-2.0)
        P = np.asarray(np.linalg.inv(information))
        values = before + P @ (self._gradient[unknown] - before / self._std**2)
        if self._clock is not None:
            values, P = _with_prior(values, P, self._clock)
        if not self.are_of_antenna:
            error = np.where(unknown < CLOCK, values, 0.0)
            values, P = values - error, P + np.outer(error, error)
        step = values - before
        self.covariance[np.ix_(unknown, unknown)] = P
        if step @ np.linalg.solve(P, step) < SETTLED**2:
            return True
        self.values[unknown] = values
        return False

    def correct_adjoint(self, measurement: Measurement, before: Array, R: Array) -> None:
        """Carry the adjoint back through a measurement; ``sensitivity`` is that before it."""
        _, H, h = self._linearised(measurement, before)
        P = covariance(before)
        S = H @ P @ H.T + R
        K = np.linalg.solve(S, H @ P).T
        m = self._adjoint
        self._adjoint = m - H.T @ (K.T @ m) + H.T @ np.linalg.solve(S, h)

    def propagate_adjoint(self, F: Array, lengths: Array) -> None:
        """Carry the adjoint back over covariance steps, see `propagate`."""
        steps = zip(F.reshape(-1, N_ERROR, N_ERROR)[::-1], lengths[::-1].tolist(), strict=True)
        for A, length in steps:
            self._adjoint = self._adjoint + length * (A.T @ self._adjoint)

    def smoothed(self, nav: Array) -> Array:
        """
        Return the sensitivity (15, 4) of the smoothed state, ``nav`` being the forward one.

        That of the position may be the antenna's, which is moved by the lever arm itself.
        """
        s = self.sensitivity - covariance(nav) @ self._adjoint
        if self.are_of_antenna:
            s[DP, LEVER] += matrix_from_quat(nav[QUAT])
        return np.asarray(s)

    def consider(self, rows: Array, first: Array, last: Array, share: Array) -> None:
        """
        Add what is not known of the constants to the covariances of smoothed states.

        Parameters
        ----------
        rows : ndarray, shape (n, N_NAV)
            Flat states, changed.
        first, last : ndarray, shape (15, 4)
            `smoothed` before and behind them.
        share : ndarray, shape (n,)
            Where each is between the two, 0 to 1.
        """
        s = first + share[:, None, None] * (last - first)
        added = s @ self.covariance @ s.transpose(0, 2, 1)
        rows[:, COVARIANCE] += added[:, PACKED_ROWS, PACKED_COLUMNS]

    def _linearised(self, measurement: Measurement, nav: Array) -> tuple[Array, Array, Array]:
        """Return innovation, measurement matrix, and the innovation's sensitivity (m, 4)."""
        z, H, _ = measurement.linearise(nav)
        h = H @ self.sensitivity
        if isinstance(measurement, Fix):
            for i, step in enumerate(_STEP * np.eye(3)):
                h[:, i] += (z - _moved(measurement, step).linearise(nav)[0]) / _STEP
            h[:, CLOCK] += H[:, DP] @ nav[VELOCITY] + H[:, DV] @ nav[ACCELERATION]
        return z, H, h


def _with_prior(values: Array, P: Array, prior: ClockPrior) -> tuple[Array, Array]:
    """Return estimate and covariance with the prior of the clock offset, their last component."""
    offset, variance = values[-1].item(), P[-1, -1].item()
    mean, left = prior.posterior(offset, variance, offset, variance, variance)
    gain = P[:, -1] / variance
    return values + gain * (mean - offset), P - (variance - left) * np.outer(gain, gain)


def _moved(fix: Fix, by_b: Array) -> Fix:
    """Return a fix with the antenna's lever arm changed by ``by_b``."""
    return replace(fix, lever_b=fix.lever_b + by_b)
