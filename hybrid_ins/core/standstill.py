"""
Whether a vehicle stands, seen from its IMU alone.

Standing is calm at two time scales: no sample strays far, and means over tenths of a second do not
move at all. Vibration fails the first, a hovering drone's balancing the second. A smooth cruise
passes both: whoever uses the answer must also know that the speed may be zero.

References
----------
.. [1] P. Groves, *Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems*,
       2nd ed., section 15.3 (zero updates).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

STANDING_FORCE_STD = 0.3  # m/s², of the samples
STANDING_RATE_STD = 0.02  # rad/s
SLOW_FORCE_STD = 0.05  # m/s², of the means, beyond what the samples' noise explains
SLOW_RATE_STD = 0.003  # rad/s
LARGEST_MEAN_RATE = 0.06  # rad/s: bias, not a turn
MEANS = 8  # per window


def is_standing(samples: NDArray[np.void]) -> bool:
    """Tell whether the vehicle stood during ``samples`` (``SAMPLE_DTYPE``), about a second."""
    size = len(samples) // MEANS
    if size < 2:
        return False
    for channel, std, slow_std in (
        ("f", STANDING_FORCE_STD, SLOW_FORCE_STD), ("w", STANDING_RATE_STD, SLOW_RATE_STD)
    ):
        readings = samples[channel][-MEANS * size:]
        noise = readings.std(axis=0)
        means = readings.reshape(MEANS, size, 3).mean(axis=1).std(axis=0)
        if np.any(noise > std) or np.any(means > np.hypot(slow_std, 2.0 * noise / np.sqrt(size))):
            return False
    return bool(np.all(np.abs(samples["w"].mean(axis=0)) < LARGEST_MEAN_RATE))
