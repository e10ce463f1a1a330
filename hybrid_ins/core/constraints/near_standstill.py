"""
A stand with the engine on, or a crawl: from the spectrum of the samples, where fixes are missing.

Vibration hides a stand from the variance of the samples, not from their spectrum: there is next to
nothing below the frequencies of engines. But at a steady crawl an IMU reads what it reads at rest,
so that this shows no more than a speed near zero. Nor does every vehicle that drives read
otherwise: the windows of motion with fixes are counted, and where some look like a stand, or too
few were seen, nothing is concluded. A ferry sets off as smoothly as its engine runs: once the mean
specific force has changed, the stand has ended.

References
----------
.. [1] P. Groves, *Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems*,
       2nd ed., section 15.3 (zero updates).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.constraints.nonholonomic import Nose, point_velocity
from hybrid_ins.core.imu.samples import readings_of
from hybrid_ins.core.imu.standstill import (
    LARGEST_MEAN_RATE,
    SLOW_STD,
    StandingForce,
)
from hybrid_ins.core.inertial.state import covariance
from hybrid_ins.core.update.measurements import IMU

Array = NDArray[np.float64]

WINDOW_NS = 1_000_000_000  # of samples whose spectrum is compared
SHORTEST_WINDOW = 0.8  # s, of such a window
FEWEST_SAMPLES = 16  # samples of it
MOTION_BAND = (0.5, 5.0)  # Hz
VIBRATION = 10.0  # Hz, from which on there is none of a vehicle's motion
LEAKAGE = 0.03  # of vibration into the frequencies of motion
CRAWL = 0.3  # m/s, of the fastest crawl whose spectrum is that of a stand
CRAWL_STD = CRAWL / math.sqrt(3.0)  # m/s: any speed up to that is as likely as another
SMOOTHEST_NS = 1_500_000_000  # of the stand's spectrum: a smooth second of a drive is no stand
MOVING = 2.0 * CRAWL  # m/s, from which on `CRAWL_STD` would not be true
MOTION_MEMORY = 300.0  # s over which windows of motion are remembered
FEWEST_MOVING = 100.0  # of them
MOST_ALIKE = 0.02  # share of them that may look like a stand
KNOWN_SPEED = 3.0  # m/s, σ: a filter that knows its speed no better finds zero plausible in a drive
PLAUSIBLE_NIS = 10.8  # chi-square, 1 degree of freedom, 99.9 %


def only_vibrates(samples: NDArray[np.void]) -> bool:
    """Return whether ``samples`` (``SAMPLE_DTYPE``), about a second, show vibration at most."""
    if len(samples) < FEWEST_SAMPLES:
        return False
    span = (int(samples["t_ns"][-1]) - int(samples["t_ns"][0])) * 1e-9
    readings = readings_of(samples)
    if span < SHORTEST_WINDOW or np.any(np.abs(readings[:, 3:].mean(axis=0)) > LARGEST_MEAN_RATE):
        return False
    window = np.hanning(len(readings))[:, None]
    power = np.abs(np.fft.rfft((readings - readings.mean(axis=0)) * window, axis=0)) ** 2
    power *= 2.0 / (float(np.sum(window**2)) * len(readings))
    frequency = np.fft.rfftfreq(len(readings), span / (len(readings) - 1))
    low, high = MOTION_BAND
    slow = power[(frequency >= low) & (frequency < high)].sum(axis=0)
    vibration = power[frequency >= VIBRATION].sum(axis=0)
    return bool(np.all(slow < SLOW_STD**2 + LEAKAGE**2 * vibration))


@dataclass(frozen=True, slots=True)
class NearStandstill:
    """
    No speed along the nose, to `CRAWL_STD`.

    A crawl lasts: its error is the same in each of these measurements. So R leaves of the speed's
    variance what one of them alone leaves at best, however many there are.
    """

    t_ns: int  # ns
    rate_b: Array  # (3,) rad/s, the gyroscopes' reading
    nose: Nose

    kind: ClassVar[str] = "near standstill"
    sensor: ClassVar[str] = IMU
    in_body: ClassVar[bool] = True

    def linearise(self, nav: Array) -> tuple[Array, Array, Array]:
        """See `Measurement.linearise`: H is that of the velocity along the nose."""
        z, H = self.innovation(nav)
        variance = float(H[0] @ covariance(nav) @ H[0])
        excess = max(variance - CRAWL_STD**2, 1e-6 * variance)
        return z, H, np.array([[CRAWL_STD**2 * variance / excess]])

    def innovation(self, nav: Array) -> tuple[Array, Array]:
        """Return z (1,) and H (1, 15) at a flat state."""
        velocity_b, by_error = point_velocity(nav, self.rate_b, self.nose.point_b)
        forward = self.nose.forward[None]
        return -forward @ velocity_b, forward @ by_error


class NearStandstillDetector:
    """
    Tells the spectrum of a stand from that of a drive, where the drive has shown the difference.

    Attributes
    ----------
    moving, alike : float
        Windows in which fixes showed motion, and those of them that look like a stand; they fade.
    """

    def __init__(self) -> None:
        self.moving = self.alike = 0.0
        self.restart()

    def restart(self) -> None:
        """Restart, as the filter did; the vehicle is the same."""
        self._still_ns: int | None = None  # since when the spectrum is that of a stand
        self._force = StandingForce()
        self._set_off = False  # since then the mean specific force has changed

    @property
    def distinguishes(self) -> bool:
        """The spectrum of this vehicle in motion was never, or hardly ever, that of a stand."""
        return self.moving > FEWEST_MOVING and self.alike < MOST_ALIKE * self.moving

    def learn(self, samples: NDArray[np.void], nav: Array, interval: float, nose: Nose) -> None:
        """
        Count a window of samples whose speed fixes have determined.

        Parameters
        ----------
        samples : ndarray of ``SAMPLE_DTYPE``
            The last second.
        nav : ndarray, shape (N_NAV,) or longer
            Flat state at their end.
        interval : float
            Time since the last window [s].
        nose : Nose
        """
        self.restart()
        speed, variance = _speed(NearStandstill(0, samples["w"][-1], nose), nav)
        if abs(speed) - 2.0 * math.sqrt(variance) > MOVING:
            fading = math.exp(-interval / MOTION_MEMORY)
            self.moving = fading * self.moving + 1.0
            self.alike = fading * self.alike + only_vibrates(samples)

    def measurement(
        self, samples: NDArray[np.void], nav: Array, rate_b: Array, nose: Nose
    ) -> NearStandstill | None:
        """Return the measurement at the last of ``samples``, in an outage; None: there is none."""
        if not (self.distinguishes and only_vibrates(samples)):
            self.restart()
            return None
        t_ns = int(samples["t_ns"][-1])
        if self._still_ns is None:
            self._still_ns = t_ns
        self._set_off = self._force.changes(samples) or self._set_off
        found = NearStandstill(t_ns, rate_b, nose)
        speed, variance = _speed(found, nav)
        plausible = CRAWL_STD**2 < variance < KNOWN_SPEED**2
        plausible = plausible and speed**2 < PLAUSIBLE_NIS * (variance + CRAWL_STD**2)
        lasts = t_ns - self._still_ns >= SMOOTHEST_NS and not self._set_off
        return found if plausible and lasts else None


def _speed(measurement: NearStandstill, nav: Array) -> tuple[float, float]:
    """Return the speed along the nose [m/s] of a flat state, and its variance."""
    z, H = measurement.innovation(nav)
    return -float(z[0]), float(H[0] @ covariance(nav) @ H[0])
