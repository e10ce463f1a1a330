"""The filter's state as it would be had nothing aided it for some seconds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.imu.samples import ImuRing, readings_of, steps_since
from hybrid_ins.core.inertial import propagation

Array = NDArray[np.float64]

SPAN_NS = 4_000_000_000
LONGEST_STEP_NS = 100_000_000  # between samples; what a longer one hides is not known without aid


class UnaidedState:
    """
    A state that only the IMU's samples move, since four to eight seconds.

    A second one begins four seconds later, and takes its place.

    Attributes
    ----------
    since_ns : int
        When the state was that of the filter [ns].
    """

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Begin anew with the next state of the filter."""
        self._navs: list[tuple[int, Array]] = []  # when they began [ns], flat states; oldest first
        self._t_ns = 0

    @property
    def since_ns(self) -> int:
        """See above."""
        return self._navs[0][0]

    def follow(self, nav: Array, t_ns: int, ring: ImuRing, interval: float) -> Array:
        """
        Propagate to where the filter is; return a copy of the flat state there.

        Parameters
        ----------
        nav : ndarray, shape (N_FLAT,)
            The filter's, with nothing pending.
        t_ns : int
            Its stamp [ns].
        ring : ImuRing
            Recent samples.
        interval : float
            See `propagation.step`.
        """
        samples = ring.between(self._t_ns, t_ns)
        steps = steps_since(self._t_ns, samples["t_ns"]) if len(samples) else np.zeros(1, np.int64)
        if not self._navs or steps.max() > LONGEST_STEP_NS:
            self._navs = [(t_ns, nav.copy())]
        elif len(samples):
            dt, readings = steps * 1e-9, readings_of(samples)
            for _, unaided in self._navs:
                propagation.run(unaided, dt, readings, interval, propagation.NO_ROWS)
                propagation.propagate_covariance(unaided)
        self._t_ns = t_ns
        if t_ns - self._navs[-1][0] >= SPAN_NS:
            self._navs = [self._navs[-1], (t_ns, nav.copy())]
        return self._navs[0][1].copy()
