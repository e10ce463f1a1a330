"""
Slow turns of a vehicle that stands: a boat in calm water, a mast, a turntable.

They read like a bias of the gyroscopes about the vertical that begins to drift: a zero-rotation
update every half second would follow it, and the heading would stay behind the vehicle's. A bias
drifts less in ten seconds, and not about the vertical alone.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.imu.samples import as_numbers
from hybrid_ins.core.imu.standstill import mean_and_std
from hybrid_ins.core.inertial.state import B_G, EPS, N_ERROR
from hybrid_ins.core.update.measurements import STANDING_RATE_STD, Standstill

Array = NDArray[np.float64]

AGO_NS = 10_000_000_000  # before now, at the least, when a turn that is noticed had not begun
MEMORY_NS = 30_000_000_000  # of rates
FEWEST = 4  # rates, that a mean is of
PAUSE_NS = 5_000_000_000  # after which another stand begins: fixes that jump interrupt one
DRIFT = 1e-4  # rad/s/√s, of a bias
SIGNIFICANT = 4.0  # standard deviations of noise and drift
ASIDE = 0.5  # of a change about the vertical, that there may be across it
KNOWN = 2.0  # σ of the bias before the stand, by which a turn has to exceed it to be corrected
ENDED = 10  # checks in a row without a turn, after one


class _Change(NamedTuple):
    """Change of a rate, and what noise and drift explain of it."""

    rate: Array  # (3,) rad/s, b
    sigma: float  # rad/s

    def turn(self, down_b: Array) -> float:
        """Return its size about the vertical [rad/s]; 0: noise or drift may have made it."""
        size = abs(float(self.rate @ down_b))
        return size if size > SIGNIFICANT * self.sigma else 0.0

    def aside(self, down_b: Array) -> float:
        """Return its size across the vertical [rad/s]."""
        return float(np.linalg.norm(self.rate - (self.rate @ down_b) * down_b))


class _Rate(NamedTuple):
    """Mean rate of a second."""

    t_ns: int
    mean: Array  # (3,) rad/s, b
    variance: float  # (rad/s)², of each component

    def change_from(self, before: _Rate) -> _Change:
        """Return how it differs from an earlier one."""
        drift = DRIFT**2 * min(self.t_ns - before.t_ns, MEMORY_NS) * 1e-9
        sigma = math.sqrt(self.variance + before.variance + drift)
        return _Change(self.mean - before.mean, sigma)


class TurnNoticed(NamedTuple):
    """A turn that began some seconds ago, or that has ended."""

    std: Array  # (15,) of what the stand has taught wrongly
    stand: Standstill | None  # without a turn; None: too little is known of the bias


class SlowTurn:
    """
    Compares the mean rate of a stand with that of ten to thirty seconds ago.

    A turn that goes on is one however long it lasts: a bias that drifts without end is a turn, too.
    A turn that a stand begins with is noticed when it ends, since the rate then is nearer to the
    bias that was known before the stand.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget the stand."""
        self._rates: deque[_Rate] = deque()
        self._known: tuple[Array, Array] | None = None  # bias and its σ, at the stand's begin
        self._before: _Rate | None = None
        self._without = 0  # checks in a row

    @property
    def turns(self) -> bool:
        """The vehicle turns while it stands: its mean rate is no bias."""
        return self._before is not None

    def follow(
        self, samples: NDArray[np.void], stands: bool, bias_g: Array, bias_std: Array
    ) -> TurnNoticed | None:
        """
        Use the last second of samples; return a turn when it is noticed.

        ``bias_g`` and ``bias_std`` are the gyroscopes' bias by the filter and its σ [rad/s], each
        of shape (3,): at the begin of a stand they show whether the rate then was a turn already.
        """
        t_ns = int(samples["t_ns"][-1])
        if self._rates and t_ns - self._rates[-1].t_ns > PAUSE_NS:
            self.reset()
        if not stands:
            return None
        bias_g, bias_std = self._known = self._known or (bias_g.copy(), bias_std.copy())
        mean, std = mean_and_std(as_numbers(samples))
        rate = _Rate(t_ns, mean[3:], float(np.max(std[3:] ** 2)) / len(samples))
        down_b = -mean[:3] / np.linalg.norm(mean[:3])
        earlier = self._earlier(rate)
        if earlier is None:
            return None
        change = rate.change_from(earlier)
        if self._before is not None:
            is_new = change.turn(down_b) > 0.0
            goes_on = is_new or rate.change_from(self._before).turn(down_b) > 0.0
            self._without = 0 if goes_on else self._without + 1
            if self._without >= ENDED:
                self._before, self._without = None, 0
            return None
        turn = change.turn(down_b)
        if not turn > change.aside(down_b) / ASIDE:
            return None
        off, off_before = (abs((one.mean - bias_g) @ down_b) for one in (rate, earlier))
        still = rate if off < off_before else earlier
        if still is earlier:
            self._before = earlier
        else:
            self._rates.clear()
        stand = None
        if turn > KNOWN * np.linalg.norm(bias_std * down_b):
            std_b = np.full(3, math.hypot(STANDING_RATE_STD, change.sigma))
            stand = Standstill(t_ns, still.mean, std_b)
        return TurnNoticed(_taught(turn, down_b, (t_ns - earlier.t_ns) * 1e-9), stand)

    def _earlier(self, rate: _Rate) -> _Rate | None:
        """Keep a rate; return the mean of those at the begin of what is remembered."""
        self._rates.append(rate)
        while rate.t_ns - self._rates[0].t_ns > MEMORY_NS:
            self._rates.popleft()
        past = [one for one in self._rates if rate.t_ns - one.t_ns > AGO_NS]
        if len(past) < FEWEST:
            return None
        first = past[: max(FEWEST, len(past) // 2)]
        mean = np.mean([one.mean for one in first], axis=0)
        return _Rate(first[-1].t_ns, mean, rate.variance)


def _taught(turn: float, down_b: Array, seconds: float) -> Array:
    """Return σ (15,) of what a turn at this rate [rad/s] has taught until it was noticed."""
    std = np.zeros(N_ERROR)
    std[B_G], std[EPS.stop - 1] = turn * np.abs(down_b), 0.5 * turn * seconds
    return std
