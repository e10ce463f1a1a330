"""
Share of motion in the information of innovations, where noise of the IMU feigns information.

What innovations are compared with is made of the IMU's readings. Of the information that they give,
summed up, the part that noise alone would give is none: errors in variables, [1]_. Both sums fade
over ``SHARE_TIME``.

References
----------
.. [1] W. A. Fuller, *Measurement Error Models*, 1987, sections 1.1 and 1.2 (attenuation).
"""

from __future__ import annotations

import numpy as np
from numba.extending import register_jitable

SHARE_TIME = 10.0  # s, over which the share of motion in the information is averaged


@register_jitable
def fade_sums(sums, interval):  # type: ignore[no-untyped-def]
    """Let the sums (2,), of the information and of the part of noise, fade for a time [s]."""
    left = np.exp(-interval / SHARE_TIME)
    sums[0] *= left
    sums[1] *= left


@register_jitable
def motion_share(sums):  # type: ignore[no-untyped-def]
    """Return the share of motion by the same sums."""
    return 1.0 - sums[1] / sums[0] if sums[1] < sums[0] else 0.0
