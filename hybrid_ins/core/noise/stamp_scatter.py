"""
What a position gains in covariance where the stamps of fixes scatter.

Drivers that stamp fixes when they arrive are late by a time that varies. With its standard
deviation s, a vehicle at the velocity v is off by a covariance s² v v'. `multiple_model`
finds s, once heading and clock are known: as long as they are not, they look like it.

Where a shaken IMU cruises, fixes that are precise across the motion alone would make the filter
sure of a heading that nothing shows: by its own equations, vibration is a force that would turn
the velocity with the heading. So the error counts in all horizontal directions as the share of
noise in the information of late has it, see `clock_offset`.
"""

from __future__ import annotations

import numpy as np
from numba.extending import register_jitable


@register_jitable
def stamp_covariance(velocity_n, share_of_motion, m):  # type: ignore[no-untyped-def]
    """
    Return the covariance of a position whose stamp has a standard deviation of 1 s.

    Parameters
    ----------
    velocity_n : ndarray, shape (3,)
        NED [m/s].
    share_of_motion : float
        `clock_offset.share_of_motion`.
    m : int
        Components of the position, 2 or 3.

    Returns
    -------
    ndarray, shape (m, m)
        [m²/s²], NED.
    """
    found, square = np.empty((m, m)), velocity_n[0] ** 2 + velocity_n[1] ** 2
    for a in range(m):
        for b in range(m):
            found[a, b] = share_of_motion * velocity_n[a] * velocity_n[b]
    for a in range(2):
        found[a, a] += (1.0 - share_of_motion) * square
    return found
