"""
How much of what fixes show of the heading is motion, and how certain the heading is by that alone.

A wrong heading turns the specific force: the velocity, and the position, become wrong by b per
radian, which fixes contradict. The filter's b contains what its accelerometers read. Where a
vehicle does not accelerate that is their noise, so that fixes seem to show a heading that nothing
shows: errors in variables, [1]_. The error of b is that of velocity and position by the same noise,
turned by a right angle, so of the information b' S^-1 b the noise has tr(S^-1 (H P H' - b b' σ²)),
where σ² is the variance of the heading; the rest is motion, see `motion_share`.

The variance of the heading by that share of the information is kept beside the filter, and grows
with the filter's. What it has more is *considered*, [2]_: added to the covariance of the attitude
that is reported. The filter's own is left: with the share in its gain it loses the bias of the
gyroscope, too, which it has learned from the same information.

References
----------
.. [1] W. A. Fuller, *Measurement Error Models*, 1987, sections 1.1 and 1.2 (attenuation).
.. [2] S. F. Schmidt, "Application of state-space methods to navigation problems", Advances in
       Control Systems 3, 1966.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.inertial.state import HEADING_VARIANCE, N_ERROR, PLACES
from hybrid_ins.core.noise.motion_share import fade_sums, motion_share
from hybrid_ins.core.update.linalg import factorise, whiten

Array = NDArray[np.float64]

HEADING = 8  # place in the error state
IN_FULL = (-1.0, 0.0)  # in place of `heading_information` where all of it counts

# What is known, as one flat vector.
INFORMATION, OF_NOISE = 0, 1  # of late
SUMS = slice(INFORMATION, OF_NOISE + 1)  # see `motion_share`
VARIANCE = 2  # rad², by the motion
OF_FILTER = 3  # rad², the filter's after the last correction; 0: there was none
N_VALUES = 4


class HeadingInformation:
    """
    The heading's variance by motion alone.

    A copy is a checkpoint.

    Attributes
    ----------
    values : ndarray, shape (N_VALUES,)
        What is known.
    """

    __slots__ = ("values",)

    def __init__(self) -> None:
        self.values = np.zeros(N_VALUES)

    def __copy__(self) -> HeadingInformation:
        twin = object.__new__(HeadingInformation)
        twin.values = self.values.copy()
        return twin

    def update(
        self, interval: float, shown: tuple[float, float], before: float, after: float
    ) -> None:
        """Take a correction into account, see `follow_heading`."""
        follow_heading(self.values, interval, *shown, before, after)

    def considered(self, nav: Array) -> float:
        """Return what is added to the variance of the heading that a flat state reports [rad²]."""
        return max(self.values.item(VARIANCE) - nav.item(HEADING_VARIANCE), 0.0)


@kernel()
def heading_information(packed, H, S, R):  # type: ignore[no-untyped-def]
    """
    Return the information of an innovation on the heading, and what its noise alone would give.

    Parameters
    ----------
    packed : ndarray, shape (120,)
        Upper triangle of P, before the update.
    H, S, R : ndarray, shape (m, 15), (m, m), (m, m)
        Measurement matrix, covariance of the innovation, and of the measurement.

    Returns
    -------
    information, of_noise : float
        [1/rad²].
    """
    m, variance = len(H), packed[PLACES[HEADING, HEADING]]
    root, b, of_rest = S.copy(), np.zeros(m), 0.0
    factorise(root)
    for a in range(m):
        for i in range(N_ERROR):
            b[a] += H[a, i] * packed[PLACES[i, HEADING]] / variance
    cause, unit = R.copy(), np.empty(m)
    factorise(cause)
    for c in range(m):  # tr(S^-1 R), by the columns of the root of R
        for a in range(m):
            unit[a] = cause[a, c] if a >= c else 0.0
        of_rest += whiten(root, unit)
    information = whiten(root, b)
    return information, max(m - of_rest - variance * information, 0.0)


@kernel()
def follow_heading(values, interval, information, of_noise, before, after):  # type: ignore[no-untyped-def]
    """
    Take a correction into account.

    Parameters
    ----------
    values : ndarray, shape (N_VALUES,)
        `HeadingInformation.values`; overwritten.
    interval : float
        Time since the last fix, or since the start [s].
    information, of_noise : float
        `heading_information` of a fix, or `IN_FULL`.
    before, after : float
        Variance of the filter's heading before and after the correction [rad²].
    """
    share = 1.0
    if information >= 0.0:
        if interval > 0.0:
            fade_sums(values[SUMS], interval)
        values[INFORMATION] += information
        values[OF_NOISE] += of_noise
        share = motion_share(values[SUMS])
    if values[OF_FILTER] > 0.0:
        grown = values[VARIANCE] + max(before - values[OF_FILTER], 0.0)
        gained = share * max(1.0 / after - 1.0 / before, 0.0)
        values[VARIANCE] = max(1.0 / (1.0 / grown + gained), after)
    else:
        values[VARIANCE] = after
    values[OF_FILTER] = after
