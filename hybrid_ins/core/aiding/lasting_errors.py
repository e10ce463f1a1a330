"""
How much larger the errors of an aiding sensor are than it claims, over seconds to half a minute.

Errors that last do not average: what they do to the position after an outage is told by the mean
of the innovations over a time, not by each of them. So innovations are averaged over batches of
several lengths, and the mean square of these means is compared with the variance that the filter,
with the sensor's errors as they are assumed, expects of it: the method of batch means, [1]_. The
largest ratio is the factor on R, which then has the right variance over that time whatever the
errors' size and correlation. Errors of the state and of the sensor's scale or offset count as
lasting for the whole batch; over n batches their mean square may be larger than expected by chance,
by 1 + √(2/n).

References
----------
.. [1] G. S. Fishman, "Grouping observations in digital simulation", Management Science 24, 1978.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LENGTHS = np.array([2.0, 8.0, 30.0])  # s, of batches
RATIO_MEMORY = 300.0  # s over which ratios are remembered: jumps and drifts are rare
PRIOR_COUNT = 2.0  # batches of ratio 1 that are assumed at the start
LARGEST_RATIO = 1000.0  # of what one batch has beyond the state's errors


class LastingErrors:
    """Batch means of one sensor's innovations."""

    def __init__(self) -> None:
        self._z: list[Array] = [np.zeros(0)] * len(LENGTHS)
        self._expected: list[Array] = [np.zeros(0)] * len(LENGTHS)  # of the state, of the sensor
        self._time = np.zeros(len(LENGTHS))
        self._count = np.zeros(len(LENGTHS))  # of batches, fading
        # Of each axis, over these: squared means, and what the state explains, in terms of R.
        self._sums: list[Array] = [np.zeros((2, 0))] * len(LENGTHS)

    @property
    def factor(self) -> float:
        """Factor on R by which the means of innovations are explained; at least 1."""
        return max(1.0, *map(self._factor, range(len(LENGTHS))))

    def _factor(self, i: int) -> float:
        """Return the factor by the batches of one length, of the axis that needs most."""
        n = float(self._count[i])
        if n == 0.0:
            return 1.0
        squares, of_state = self._sums[i]
        surplus = float((squares - (1.0 + math.sqrt(2.0 / n)) * of_state).max())
        return (surplus + PRIOR_COUNT) / (n + PRIOR_COUNT)

    def add(self, z: Array, of_state: Array, of_sensor: Array, interval: float) -> None:
        """
        Add an innovation.

        Parameters
        ----------
        z : ndarray, shape (m,)
            Innovation.
        of_state : ndarray, shape (m, m)
            Covariance of what lasts: the state, the sensor's known systematic errors.
        of_sensor : ndarray, shape (m, m)
            Covariance of the rest with which the innovation counts as white: R as it is fused.
        interval : float
            Since the innovation before [s].
        """
        for i, length in enumerate(LENGTHS):
            if self._z[i].shape != z.shape:
                self._restart(i, len(z))
                self._count[i], self._sums[i] = 0.0, np.zeros((2, len(z)))
            self._z[i] = self._z[i] + interval * z
            self._expected[i] = self._expected[i] + np.stack(
                (interval * of_state, interval**2 * of_sensor)
            )
            self._time[i] += interval
            if self._time[i] >= length:
                self._close(i)

    def _restart(self, i: int, m: int) -> None:
        self._z[i], self._expected[i], self._time[i] = np.zeros(m), np.zeros((2, m, m)), 0.0

    def _close(self, i: int) -> None:
        """Compare the mean of a batch with what is expected of it, and begin the next."""
        time, m = self._time[i], len(self._z[i])
        mean = self._z[i] / time
        of_state, of_sensor = self._expected[i][0] / time, self._expected[i][1] / time**2
        explained = of_state.diagonal() / of_sensor.diagonal()
        square = np.minimum(mean**2 / of_sensor.diagonal(), explained + LARGEST_RATIO)
        fading = math.exp(-time / RATIO_MEMORY)
        self._count[i] = fading * self._count[i] + 1.0
        self._sums[i] = fading * self._sums[i] + np.stack((square, explained))
        self._restart(i, m)
