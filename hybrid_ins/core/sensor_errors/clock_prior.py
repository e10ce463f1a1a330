"""
Prior of the clock offset of fixes, and what a measurement of the offset leaves of it.

Many clocks are right to a few milliseconds, as many are wrong by tenths of a second, and no single
normal distribution says both: a narrow one would hold a wrong clock back for minutes, a wide one
would let noise move a right clock. A mixture of normal distributions whose scales form a geometric
sequence has both a narrow peak and heavy tails, [1]_: an estimate of little significance is shrunk
towards the given offset, and one of several standard deviations is left as it is.

References
----------
.. [1] C. M. Carvalho, N. G. Polson, J. G. Scott, "The horseshoe estimator for sparse signals",
       Biometrika 97, 2010 (scale mixtures as priors of what is mostly zero).
"""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

RATIOS = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0)  # scales over the narrowest
SHARES = (0.1, 0.1, 0.1, 0.1, 0.1, 0.5)  # their probabilities
NARROWEST, WIDEST = 1e-3, 0.3  # s


class ClockDrift(NamedTuple):
    """
    Drift that is expected: the rate of change of the offset.

    Attributes
    ----------
    mean, std : float
        And its standard deviation [s/s].
    """

    mean: float = 0.0
    std: float = 1e-4


UNKNOWN_DRIFT = ClockDrift()


class ClockPrior(NamedTuple):
    """
    Offsets that are expected.

    Attributes
    ----------
    mean : float
        The given offset, relative to the one in force [s].
    scale : float
        Standard deviation of the narrowest part [s].
    t_ns : int
        When the offset was that [ns]; 0: at the start of a filter.
    """

    mean: float
    scale: float
    t_ns: int = 0

    def at(self, t_ns: int, drift: ClockDrift) -> ClockPrior:
        """Return the prior of the offset at a stamp [ns], of a clock with a drift."""
        age = (t_ns - self.t_ns) * 1e-9 if self.t_ns else 0.0
        scale = math.hypot(self.scale, age * drift.std)
        return ClockPrior(self.mean + age * drift.mean, scale)

    def is_close(self, other: ClockPrior) -> bool:
        """Return whether another prior is the same but for rounding."""
        return self[1:] == other[1:] and math.isclose(self.mean, other.mean, abs_tol=1e-9)

    def posterior(
        self, estimate: float, variance: float, at_start: float, spread: float, shared: float
    ) -> tuple[float, float]:
        """
        Return mean [s] and variance [s²] of the offset now.

        The prior is of the offset at a start: a clock that drifts leaves it behind.

        Parameters
        ----------
        estimate, variance : float
            Of a measurement of the offset now, normally distributed [s, s²].
        at_start, spread, shared : float
            What the same measurement says of the offset at the start [s], its variance as far as
            the prior does not contain it, and the covariance of both [s²].
        """
        total, first, second = 0.0, 0.0, 0.0
        away = self.mean - at_start
        exponent = -0.5 * away**2
        for share, scale in zip(SHARES, _scales(self.scale), strict=True):
            sum_ = scale**2 + spread
            weight = share * math.exp(max(exponent / sum_, -600.0)) / math.sqrt(sum_)
            gain = shared / sum_
            total += weight
            first += weight * gain * away
            second += weight * (variance - gain * shared + (gain * away) ** 2)
        mean = first / total
        return estimate + mean, max(second / total - mean**2, 0.0)

    def probability(self, low: float, high: float) -> float:
        """Return the probability of offsets between two [s], relative to the one in force."""
        return math.fsum(
            share
            * (_normal_cdf((high - self.mean) / scale) - _normal_cdf((low - self.mean) / scale))
            for share, scale in zip(SHARES, _scales(self.scale), strict=True)
        )


@cache
def _scales(narrowest: float) -> tuple[float, ...]:
    """Return the standard deviations of the parts [s], by that of the narrowest."""
    narrowest = max(narrowest, NARROWEST)
    return tuple(min(narrowest * ratio, max(WIDEST, narrowest)) for ratio in RATIOS)


def _normal_cdf(x: float) -> float:
    return 0.5 * (1.0 + math.erf(x / math.sqrt(2.0)))
