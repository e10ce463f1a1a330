"""
The slow error of GNSS positions.

The slow error is *considered*, [1]_: the state is that of a vehicle displaced by it, so B is added
to the covariance of the position that is reported, not to that of the filter. From fix to fix it
changes, as a random walk of position, of which there is as much as successive innovations show,
[2]_. Where the claimed variance falls or rises by more than a factor, the receiver has found
another solution: the old slow error is left in the state, or a new one begins. Of a claim that is
larger than the smallest of this receiver the rest is slow: what is lost are ambiguities, or
satellites.

A receiver may also claim centimetres and err slowly by a metre. No claim bounds that error, but the
IMU does: between fixes the positions change by more than the vehicle moved. Its variance is then
the one that the innovations show (`multiple_model`).

References
----------
.. [1] S. F. Schmidt, "Application of state-space methods to navigation problems", Advances in
       Control Systems 3, 1966.
.. [2] R. K. Mehra, "On the identification of variances and adaptive Kalman filtering", IEEE
       Transactions on Automatic Control 15, 1970.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.inertial.state import COVARIANCE, DIAGONAL, SLOW_VARIANCE

Array = NDArray[np.float64]
Shares = tuple[float, float]
"""Horizontally and vertically."""

SLOW_TIME = 100.0  # s, correlation time of the slow error
SLOW_AXES = np.array([1.0, 1.0, 2.25])  # NED, of its variance where no claim gives them
HEIGHT_RATIO = math.sqrt(SLOW_AXES[2])  # of the height's standard deviation
LASTING = 30.0  # s; within `weights.MEMORY` other explanations come and go
NO_GROWTH = np.zeros(3)  # m², of a slow error
NEW_SOLUTION = 4.0  # times the slow error's variance, or less than one part: another error


class SlowError(NamedTuple):
    """
    A slow error that the innovations show, and what is left of those that were probable before.

    Noise of the accelerometers explains much of the same, and may be the likelier one for seconds.
    And fixes that are off by the same for seconds look as if the error were gone: of ``past`` the
    filter knows nothing, but the covariance that is reported contains it. So it does an error that
    the receiver, or the state, must have had where they disagreed.
    """

    stds: Shares = (0.0, 0.0)  # m, as the argument of `PositionScatter.split`
    lasting: Shares = (0.0, 0.0)  # m, of the last one that was probable; they fade
    past: Shares = (0.0, 0.0)  # m, of the largest that was shown, or that may have been; they fade
    t_ns: int = 0

    def updated(self, shown: Shares, is_probable: bool, t_ns: int) -> SlowError:
        """Return it with what they show at a stamp [ns]."""
        left = math.exp(-max(t_ns - self.t_ns, 0) * 1e-9 / LASTING)
        past = _larger(shown, (left * self.past[0], left * self.past[1]))
        if is_probable:
            return SlowError(shown, shown, past, t_ns)
        lasting = left * self.lasting[0], left * self.lasting[1]
        return SlowError(_larger(shown, lasting), lasting, past, t_ns)

    def doubted(self, z: Array) -> SlowError:
        """
        Return it where the receiver may be what is wrong, by an innovation of positions.

        ``z``, shape (m,) [m], NED, may lack the height.
        """
        across = math.hypot(z[0], z[1]) / math.sqrt(2.0)
        upward = abs(float(z[2])) / HEIGHT_RATIO if len(z) == 3 else across
        return self._replace(past=_larger(self.past, (across, upward)))

    @property
    def past_variance(self) -> Array:
        """Variance of the largest ``past`` one, as far as it lasts [m²], (3,), NED."""
        across, upward = self.past
        return np.asarray(SLOW_AXES * np.square((across, across, upward)))

    @property
    def drifts(self) -> Shares:
        """What was probable [m]: of positions, and of heights alone."""
        across, upward = self.lasting
        return in_metres((across, math.sqrt(max(upward**2 - across**2, 0.0))))


def _larger(stds: Shares, others: Shares) -> Shares:
    return max(stds[0], others[0]), max(stds[1], others[1])


def in_metres(slow_stds: Shares) -> Shares:
    """Return standard deviations of slow errors [m], see `PositionScatter.split`, by axis."""
    return slow_stds[0], slow_stds[1] * HEIGHT_RATIO


@register_jitable
def slow_error_growth(before, after, interval):  # type: ignore[no-untyped-def]
    """Return the variance [m²] that a slow error leaves in the state over an interval [s]."""
    return before if before > NEW_SOLUTION * after else 2.0 * before * interval / SLOW_TIME


@kernel()
def slow_part(  # type: ignore[no-untyped-def]
    claimed, across, upward, least, shown_across, shown_upward, before, interval
):
    """
    Return the slow part of a claimed variance.

    Parameters
    ----------
    claimed : ndarray, shape (m, m)
        Covariance that a position claims [m²], NED.
    across, upward, least : float
        Shares that are white, horizontally and vertically, and the least that is slow.
    shown_across, shown_upward : float
        ``slow_stds`` of `PositionScatter.split`.
    before : ndarray, shape (n,)
        Slow part [m²] of the claim before; empty: there was none.
    interval : float
        Since that [s].

    Returns
    -------
    slow, claimed_slow, growth : ndarray, shape (m,), (m,), (3,)
        See `Split`.
    """
    m = len(claimed)
    slow, claimed_slow, growth = np.empty(m), np.empty(m), np.zeros(3)
    for i in range(m):
        white, shown = (upward, shown_upward) if i == 2 else (across, shown_across)
        after = claimed_slow[i] = claimed[i, i] * max(1.0 - white, least)
        slow[i] = max(after, SLOW_AXES[i] * shown**2)
        if i < len(before):
            is_new = after > NEW_SOLUTION * before[i]
            growth[i] = after if is_new else slow_error_growth(before[i], after, interval)
    return slow, claimed_slow, growth


@kernel()
def change_slow_error(nav, variance, interval, claimed_growth):  # type: ignore[no-untyped-def]
    """
    Let the slow error of fixes change over an interval [s], to a new variance [m²], NED.

    ``variance``, shape (m,), may lack the height. P grows by ``claimed_growth`` at the least, see
    `Split`. Overwrites P and B of the flat state ``nav``.
    """
    for i in range(len(variance)):
        grown = slow_error_growth(nav[SLOW_VARIANCE][i], variance[i], interval)
        nav[COVARIANCE][DIAGONAL[i]] += max(grown, claimed_growth[i])
        nav[SLOW_VARIANCE][i] = variance[i]
