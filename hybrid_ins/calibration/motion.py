"""
What the motion of a recording shows of the clock offset, its noise left out.

A fix that is dated wrong is off by the change of the motion, and the likelihood compares fixes with
the INS at other times. Where a vehicle cruises and its IMU is shaken, that compares them with
other stretches of the IMU's noise: one of these fits best by chance, and by so much that the
likelihood's curvature and the scatter of its scores make it certain to milliseconds. So the
information on the offset counts by the share of motion in it, as for the running filter,
`hybrid_ins.core.sensor_errors.clock_offset` and [1]_.

References
----------
.. [1] W. A. Fuller, *Measurement Error Models*, 1987, sections 1.1 and 1.2 (attenuation).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.calibration.filter_pass import FilterPass
from hybrid_ins.calibration.innovations import POSITION, VELOCITY
from hybrid_ins.calibration.recording import Recording
from hybrid_ins.core.noise.motion_share import SHARE_TIME
from hybrid_ins.core.sensor_errors.clock_offset import MARGIN

Array = NDArray[np.float64]


def std_by_motion(passes: Sequence[FilterPass], recordings: Sequence[Recording]) -> float:
    """
    Return the standard deviation [s] of a clock offset by the motion; infinite without any.

    Parameters
    ----------
    passes : sequence of FilterPass
        With what each innovation says of the offset.
    recordings : sequence of Recording
        Those with this clock.
    """
    information = 0.0
    for passed, recording in zip(passes, recordings, strict=True):
        for kind in (POSITION, VELOCITY):
            rows = recording.aid_kind == kind
            whole, of_noise = passed.clock[rows].T
            share = _share_of_motion(recording.aid_t[rows], whole, of_noise)
            information += float(share**2 @ whole)
    return MARGIN / math.sqrt(information) if information > 0.0 else math.inf


def _share_of_motion(t: Array, information: Array, of_noise: Array) -> Array:
    """Return the share of motion in the information around each time, shape (M,)."""
    first = np.searchsorted(t, t - SHARE_TIME)
    stop = np.searchsorted(t, t + SHARE_TIME, side="right")

    def around(values: Array) -> Array:
        sums = np.concatenate(([0.0], np.cumsum(values)))
        return np.asarray(sums[stop] - sums[first])

    known = np.maximum(around(information), 1e-300)
    return np.maximum(1.0 - around(of_noise) / known, 0.0)
