"""
Detection of a standing vehicle from its IMU.

While a vehicle stands, the samples vary little, and their means over tenths of a second do not vary
beyond what the samples' noise explains. Vibration fails the first test, a hovering drone's control
the second. A smooth cruise passes both: the caller must also check that zero speed is plausible
(`may_be_zero`), that the fixes of the last seconds show no motion (`fix_motion`), and that the
vehicle has shown no cruise as calm at speeds that are plausible, too (`Glides`). A train that sets
off gently passes them, too: its acceleration hardly changes in a second, but since the stand began
it does.

References
----------
.. [1] P. Groves, *Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems*,
       2nd ed., section 15.3 (zero updates).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.imu.fix_motion import MIN_SPEED
from hybrid_ins.core.imu.samples import as_numbers, readings_of

STANDING_FORCE_STD = 0.3  # m/s², of the samples
STANDING_RATE_STD = 0.02  # rad/s
SLOW_FORCE_STD = 0.05  # m/s², of the means, beyond what the samples' noise explains
SLOW_RATE_STD = 0.003  # rad/s
LARGEST_MEAN_RATE = 0.06  # rad/s: bias, not a turn
SWAY = 5.0  # of a rate over its spread within a window: that of one in nine of its lengths
MEANS = 8  # per window
LONGEST_BRAKING_NS = 10_000_000_000  # of steady braking, which resembles standing until it ends
SPEED_NIS_STANDING = 7.8  # chi-square, 3 degrees of freedom, 95 %
_STD = np.repeat((STANDING_FORCE_STD, STANDING_RATE_STD), 3)
SLOW_STD = np.repeat((SLOW_FORCE_STD, SLOW_RATE_STD), 3)


def is_standing(samples: NDArray[np.void]) -> bool:
    """Return whether the vehicle stood during ``samples`` (``SAMPLE_DTYPE``), about a second."""
    if len(samples) < 2 * MEANS:
        return False
    noise, slow, explained = _spreads(samples)
    if np.any(noise > _STD) or np.any(slow > np.hypot(SLOW_STD, explained)):
        return False
    mean, _ = mean_and_std(as_numbers(samples))
    return bool(np.all(np.abs(mean[3:]) < LARGEST_MEAN_RATE))


def sway(samples: NDArray[np.void]) -> NDArray[np.float64]:
    """
    Return the standard deviation (3,) [rad/s] of the mean rate of a stand about the bias.

    A hull or a vehicle on soft ground sways slowly, and one that comes to rest still turns: within
    a second the rate changes little, and its mean is not the bias. What the samples' noise does not
    explain of the change shows it.
    """
    noise, slow, explained = _spreads(samples)
    beyond = np.square(slow) - np.square(explained)
    count = len(samples)
    at = np.arange(count) - 0.5 * (count - 1)
    ramp = at @ samples["w"] / (np.linalg.norm(at) * np.sqrt(count))  # its standard deviation
    steady = np.square(ramp) - np.square(2.0 * noise[3:]) / count
    return np.asarray(SWAY * np.sqrt(np.maximum(np.maximum(beyond[3:], steady), 0.0)))


def _spreads(samples: NDArray[np.void]) -> tuple[NDArray[np.float64], ...]:
    """
    Return standard deviations (6,) of readings, of their means, and what noise explains of these.

    There are ``MEANS`` of the last samples.
    """
    size = len(samples) // MEANS
    noise, slow = _spread(readings_of(samples)[-MEANS * size :], size)
    return noise, slow, 2.0 * noise / np.sqrt(size)


def may_be_zero(velocity_n: NDArray[np.float64], covariance_n: NDArray[np.float64]) -> bool:
    """Return whether zero is plausible for a velocity (3,) [m/s] with its covariance (3, 3)."""
    nis = velocity_n @ np.linalg.solve(covariance_n, velocity_n)
    return bool(nis < SPEED_NIS_STANDING)


class StandingForce:
    """
    Mean specific force of a stand: it stays as it is, or the vehicle sets off or is tilted.

    A zero-velocity update while a vehicle sets off would make its acceleration a bias.
    """

    def __init__(self) -> None:
        self._mean: NDArray[np.float64] | None = None

    def reset(self) -> None:
        """Forget the stand."""
        self._mean = None

    def changes(self, samples: NDArray[np.void]) -> bool:
        """Return whether the mean of ``samples`` is another than when the stand began."""
        means, stds = mean_and_std(as_numbers(samples))
        mean, before = means[:3], self._mean
        noise = 4.0 * float(stds[:3].max()) / np.sqrt(len(samples))
        changed = before is not None and bool(
            np.linalg.norm(mean - before) > np.hypot(SLOW_FORCE_STD, noise)
        )
        if before is None or changed:
            self._mean = mean
        return changed


class Glides:
    """
    Speeds by fixes at which the IMU was calm for as long as it has to be at any stand.

    Underwater vehicles and airships cruise as calmly as they stand. Of those a calm shows no stand
    where the filter knows the speed no better than to one of these: zero is plausible then.

    Attributes
    ----------
    slowest : float
        Least of them [m/s]; inf: there were none. Of one that brakes, the speed before.
    """

    def __init__(self) -> None:
        self.slowest = math.inf
        self.reset()

    def reset(self) -> None:
        """End the glide: the samples were not calm, or fixes do not show that it goes on."""
        self._since_ns: int | None = None
        self._speed = 0.0

    def observe(self, begin_ns: int, t_ns: int, speed: float, std: float) -> None:
        """
        Use a calm window in which fixes showed motion.

        Parameters
        ----------
        begin_ns, t_ns : int
            Stamps of its samples [ns].
        speed, std : float
            The filter's, and its standard deviation [m/s].
        """
        least = speed - 2.0 * std
        if least < MIN_SPEED:  # fixes may drift as fast at a stand
            self.reset()
            return
        self._speed = max(self._speed, least)
        if self._since_ns is None:
            self._since_ns = begin_ns
        if t_ns - self._since_ns >= LONGEST_BRAKING_NS:
            self.slowest = min(self.slowest, self._speed)

    def explain(self, speed_std: float) -> bool:
        """Return whether a calm that began with that σ of the speed [m/s] may be a glide."""
        return self.slowest < speed_std


@kernel()
def _spread(readings, size):  # type: ignore[no-untyped-def]
    """Return the standard deviations (6,) of readings (N, 6), and of means over ``size`` each."""
    count, parts = readings.shape[0], readings.shape[0] // size
    noise, slow, mean = np.zeros(6), np.zeros(6), np.zeros(6)
    means = np.zeros((parts, 6))
    for part in range(parts):
        for k in range(part * size, (part + 1) * size):
            for c in range(6):
                means[part, c] += readings[k, c] / size
        for c in range(6):
            mean[c] += means[part, c] / parts
    for k in range(count):
        for c in range(6):
            noise[c] += (readings[k, c] - mean[c]) ** 2 / count
    for part in range(parts):
        for c in range(6):
            slow[c] += (means[part, c] - mean[c]) ** 2 / parts
    return np.sqrt(noise), np.sqrt(slow)


@kernel()
def mean_and_std(numbers):  # type: ignore[no-untyped-def]
    """Return mean and standard deviation (6,) of the readings in `samples.as_numbers`, (N, 7)."""
    count = numbers.shape[0]
    mean, std = np.zeros(6), np.zeros(6)
    for k in range(count):
        for c in range(6):
            mean[c] += numbers[k, 1 + c]
    mean /= count
    for k in range(count):
        for c in range(6):
            std[c] += (numbers[k, 1 + c] - mean[c]) ** 2
    return mean, np.sqrt(std / count)
