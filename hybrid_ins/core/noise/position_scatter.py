"""
Scatter of GNSS positions against what their receiver claims: a white part and a slow one.

Many receivers claim metres, which is how far off they are, and scatter by decimetres from fix to
fix: most of their error is slow, [1]_. A filter that takes all of it as white follows the fixes
less than they deserve, and its covariance, which averages white errors away, holds the absolute
error less than it claims to. So the claimed variance is split: R is the white part, a share r of
it, and the rest is the variance B of a `slow_error`, a first-order Gauss-Markov process.

The share r is learned from the innovations by its likelihood, in steps of the method of scoring,
[2]_, one horizontally and one vertically: drivers that claim a constant claim as much of heights,
which scatter by more. What was learned fades as new evidence comes in, and starts as a prior about
the given share. A receiver that scatters by more than it claims has a share above 1. The factors on
R that the innovations show (`multiple_model`) are found sooner and are coarser; the share contains
them, so R is multiplied by the larger of the two.

A filter that believed in too large an R until now has too large a P as well, and its innovations
show less than no scatter. From one fix to the next they change by the scatter of both at the least,
whatever P is: what is learned is therefore never less than a part of what they change by.

Positions that scatter as much as is claimed do not show that nothing else is wrong with them: the
errors of a receiver without corrections, from orbits, atmosphere and reflections, last for minutes,
[1]_. Of claims of a metre and more at least a share of the variance is therefore slow.

References
----------
.. [1] P. Groves, *Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems*,
       2nd ed., section 9.3 (correlated errors of GNSS).
.. [2] R. H. Shumway, D. S. Stoffer, *Time Series Analysis and Its Applications*, 4th ed., section
       6.3 (maximum likelihood estimation of state-space models).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.inertial.state import COVARIANCE
from hybrid_ins.core.noise.scatter_evidence import Evidence, scatter_evidence
from hybrid_ins.core.noise.slow_error import (
    NO_GROWTH,
    SLOW_TIME,
    Shares,
    change_slow_error,
    in_metres,
    slow_part,
)
from hybrid_ins.core.shallow_copy import ShallowCopy
from hybrid_ins.core.update.measurements import LinearModel, scaled_by_axis

Array = NDArray[np.float64]

SCATTER_MEMORY = 30.0  # s, over which the scatter is averaged
PRIOR_COUNT = 7.0  # fixes, that the given share weighs at the start, and that are remembered
MARGIN = 1.25  # on the share: one that is a little too large costs less than one too small
SMALLEST = 0.003  # share of the claimed variance
OF_CHANGES = 0.5  # least share, of half the mean square of changes: 1 to 3 times the right one
SMALLEST_STD = 0.01  # m: no receiver scatters by less
SMALLEST_CLAIM = 0.1  # m: of less, the noise factors alone find that it is too little
LEAST_SEARCHED = 0.1  # of the given share, while a heading or a clock is searched for
REFLECTED_STD = 1.5  # m, likewise: reflections near walls last for seconds, and scatter little
LARGEST_RESIDUAL = 4.0  # normalised square: more is an outlier
EXCESS = 0.25  # of the claimed variance: more than claimed by less than that is chance
LEAST_SLOW = 0.5  # of the variance of receivers that have no corrections
CORRECTED_STD, UNCORRECTED_STD = 0.3, 1.0  # m: claims with corrections, and without
WALK_GAIN = 0.3  # by which the logarithm of its walk follows the product of two innovations
WALK_FALL = 0.2  # of that, where innovations are far smaller than a covariance that is the state's
SMALLEST_WALK = 0.01
LONGEST_INTERVAL = 3.0  # s, between two such
SHORT_INTERVAL = 0.6  # s, between two whose change is the fixes', not the IMU's


class Split(NamedTuple):
    """The claimed variance of a position in two parts."""

    white: Array  # (m, m) m², NED: R at a factor of fixes of 1
    slow_variance: Array  # (m,) m², NED, the rest
    interval: float  # s, since the position before, in which the slow error has changed
    factors: Shares = (1.0, 1.0)  # all that are on the claimed covariance
    claimed_stds: Shares = (0.0, 0.0)  # m, infinite of a height that lacks; 0: no position
    claimed_slow: Array = np.empty(0)  # (m,) m², of a slow error as far as it is claimed
    claimed_growth: Array = NO_GROWTH  # m², by which the state's variance grows by that
    unclaimed_stds: Shares = (0.0, 0.0)  # m, of a slow error, where that is larger than claimed
    excess: Shares = (1.0, 1.0)  # by which positions scatter more than is claimed and given


class _Shown(NamedTuple):
    """A factor on the claimed variance of some components, as shown by sums that fade."""

    components: int
    total: float = 0.0
    seen: float = 0.0  # components

    def updated(self, total: float, count: float, interval: float) -> _Shown:
        """Return it after an interval [s], with what a fix shows, see `scatter_evidence`."""
        least = PRIOR_COUNT * self.components
        fading = max(math.exp(-interval / SCATTER_MEMORY), least / max(self.seen, least))
        largest = LARGEST_RESIDUAL * self.components * max(1.0, self.total / max(self.seen, 1.0))
        seen = fading * self.seen + count
        total = max(fading * self.total + min(total, largest), SMALLEST * seen)
        return _Shown(self.components, total, seen)

    @property
    def least(self) -> float:
        """The least share that sums of changes show."""
        return min(OF_CHANGES * self.total / self.seen, 1.0) if self.seen > 0.0 else 0.0

    def share(self, both: _Shown) -> float:
        """Return the share in R; what is not seen here yet is that of all components."""
        lacking = max(PRIOR_COUNT * self.components - self.seen, 0.0)
        mean = (self.total + lacking * both.total / both.seen) / (self.seen + lacking)
        return max(min(MARGIN * mean, 1.0), mean - EXCESS)


class PositionScatter(ShallowCopy):
    """
    Shares of the claimed variance of positions that are white.

    A copy is a checkpoint.

    Parameters
    ----------
    given : float
        The share to begin with: the square of ``gnss.position_scatter``.
    learning : bool
        Learn the share from the fixes; otherwise it stays.

    Attributes
    ----------
    learning : bool
        See above.
    learned : (float, float)
        Shares that the fixes show; the given one until they do.
    in_force : bool
        Positions are fused with the learned shares. Otherwise, while heading or clock are searched
        for, with no more than the given one, since a wrong heading looks like scatter, and with no
        less than a tenth of it, nor than ``REFLECTED_STD``: else the model's other errors are
        evidence on both. What a position claims beyond the smallest claim counts in full.
    """

    def __init__(self, given: float = 1.0, learning: bool = False) -> None:
        self._given = given
        self._t_ns = 0  # of the last position
        self._claimed_slow = np.empty(0)  # m², of its slow error
        self.in_force = False
        # m², horizontally: the smallest variance that a fused position claimed, and the last one
        self._usual = self._horizontal = math.inf
        self.begin(learning)

    def begin(self, learning: bool) -> None:
        """Return to the given share, and learn it from the fixes from now on, or do not."""
        given, self.learning = self._given, learning
        mean = given / MARGIN if given <= 1.0 else given + EXCESS
        self._both = _Shown(3, 3.0 * PRIOR_COUNT * mean, 3.0 * PRIOR_COUNT)
        self._parts = _Shown(2), _Shown(1)
        self.learned: Shares = (given, given)
        self._changes = _Shown(2), _Shown(1)  # half the square of changes of innovations
        self._normalised = np.empty(0)  # the last position's innovation
        self._by_claim: list[float] = []  # likewise, by the standard deviations that it claimed
        self._walk = 1.0  # factor on the walk of the slow error

    def shares(self, claimed: Array) -> Shares:
        """Return the shares in force for a claimed covariance (m, m)."""
        variance = horizontal_variance(claimed)
        of_horizontal, of_vertical = self.learned
        return self._share(of_horizontal, variance), self._share(of_vertical, variance)

    def _share(self, learned: float, horizontal: float) -> float:
        """Return the share in force by a learned one for a claimed variance [m²]."""
        share = learned if self.in_force else self._searched(learned, horizontal)
        if share >= 1.0:
            return share if horizontal >= SMALLEST_CLAIM**2 else self._largest_expected
        return max(share, min(1.0, SMALLEST_STD**2 / horizontal))

    def _searched(self, learned: float, horizontal: float) -> float:
        """Return it while heading or clock are searched for."""
        usual = min(self._usual, horizontal)
        least = self._given * max(LEAST_SEARCHED, min(1.0, REFLECTED_STD**2 / usual))
        share = min(max(learned, least), self._given)
        return (usual * share + (horizontal - usual) * self._given) / horizontal

    @property
    def _largest_expected(self) -> float:
        """The largest share that needs no evidence."""
        return max(1.0, self._given)

    def split(
        self,
        claimed: Array,
        t_ns: int,
        slow_stds: Shares = (0.0, 0.0),
        fix_factor: float = 1.0,
        height_factor: float = 1.0,
    ) -> Split:
        """
        Return the split of a position's covariance.

        Parameters
        ----------
        claimed : ndarray, shape (m, m)
            As the fix claims it [m²], NED; it may lack the height.
        t_ns : int
            Stamp of the fix [ns].
        slow_stds : (float, float)
            Standard deviations [m] of the slow error that the innovations show, horizontally, and
            vertically as the horizontal one that it would come with.
        fix_factor, height_factor : float
            On R, and on that of the height besides, by the innovations: the split is made for them.
        """
        self._horizontal = horizontal = horizontal_variance(claimed)
        if len(claimed) == 2:  # what were heights may have been none
            self._parts = self._parts[0], _Shown(1)
        since = (t_ns - self._t_ns) * 1e-9 if self._t_ns else 0.0
        interval = min(max(since, 0.0), 0.5 * SLOW_TIME) * (self._walk if self.in_force else 1.0)
        across, upward = self.shares(claimed)
        largest = self._largest_expected
        common = min(max(min(across, upward) / largest, 1.0), fix_factor)
        across = _without(common, across, largest)
        upward = _without(common * height_factor, upward, largest)
        excess = max(across / largest, 1.0), max(upward / largest, 1.0)
        lost = 1.0 - min(self._usual, horizontal) / horizontal
        claimed_std = math.sqrt(horizontal)
        claimed_stds = claimed_std, math.sqrt(claimed[2, 2]) if len(claimed) == 3 else math.inf
        least_slow = max(LEAST_SLOW * uncorrected(claimed_std), lost)
        slow, claimed_slow, growth = slow_part(
            claimed, across, upward, least_slow, *slow_stds, self._claimed_slow, interval
        )
        unclaimed = [
            shown if shown > claim else 0.0
            for shown, claim in zip(in_metres(slow_stds), claimed_stds, strict=True)
        ]
        on_R = across, upward * height_factor
        return Split(
            scaled_by_axis(claimed, *on_R),
            slow,
            interval,
            (on_R[0] * fix_factor, on_R[1] * fix_factor),
            claimed_stds,
            claimed_slow,
            growth,
            (unclaimed[0], unclaimed[1]),
            excess,
        )

    def split_model(
        self, nav: Array, model: LinearModel, split: Split, fix_factor: float, by_stamp: Array
    ) -> tuple[LinearModel, Evidence | None]:
        """
        Return a position's model with the white part of R, and what its scatter teaches.

        The slow error of the flat state ``nav`` becomes that of the fix. ``fix_factor`` is that on
        the covariance of fixes, ``by_stamp`` (m, m) [m²] the covariance by its stamp.
        """
        z, H, _ = model
        change_slow_error(nav, split.slow_variance, split.interval, split.claimed_growth)
        white = z, H, split.white
        if not self.learning:
            return white, None
        return white, scatter_evidence(nav[COVARIANCE], z, H, fix_factor * split.white, by_stamp)

    def learn(self, split: Split, evidence: Evidence | None, t_ns: int) -> None:
        """
        Note a fix that was fused, by its `scatter_evidence`, which ``learning`` alone needs.

        A walk of the slow error that is too large makes the filter follow the scatter, so that
        successive innovations are of opposite signs, too small a one of the same. One that is far
        too large makes all innovations small beside the state's covariance, whatever their signs.
        """
        interval = max((t_ns - self._t_ns) * 1e-9, 0.0)
        self._t_ns, self._claimed_slow = t_ns, split.claimed_slow
        self._usual = min(self._usual, self._horizontal)
        if evidence is None:
            return
        totals, counts, normalised = evidence
        claimed, seen = (totals * split.factors).tolist(), counts.tolist()
        self._both = self._both.updated(sum(claimed), sum(seen), interval)
        horizontal, vertical = self._parts
        horizontal = horizontal.updated(claimed[0], seen[0], interval)
        vertical = vertical.updated(claimed[1], seen[1], interval)
        self._parts = horizontal, vertical
        self._note_change(split.factors, seen, normalised.tolist(), interval)
        across, upward = (changes.least for changes in self._changes)
        self.learned = (
            max(horizontal.share(self._both), across),
            max(vertical.share(self._both), upward),
        )
        m = min(len(normalised), len(self._normalised))
        if m and self.in_force and interval < LONGEST_INTERVAL:
            alike = float(np.mean(np.clip(normalised[:m] * self._normalised[:m], -1.0, 1.0)))
            too_small = max(1.0 - float(np.mean(np.square(normalised))), 0.0)
            of_state = 1.0 - math.sqrt(min(sum(seen) / len(normalised), 1.0))  # the share of S
            change = alike - WALK_FALL * of_state**2 * too_small
            self._walk = min(max(self._walk * math.exp(WALK_GAIN * change), SMALLEST_WALK), 1.0)
        self._normalised = normalised

    def _note_change(
        self, factors: Shares, seen: list[float], normalised: list[float], interval: float
    ) -> None:
        """Note by how much a fix's innovation differs from the last one, see `learn`."""
        of_R = [math.sqrt(max(n / m, 1e-6)) for n, m in zip(seen, (2.0, 1.0), strict=True)]
        across, upward = (math.sqrt(f / r) for f, r in zip(factors, of_R, strict=True))
        by_claim = [z * root for z, root in zip(normalised, (across, across, upward), strict=False)]
        halves = [0.5 * (z - last) ** 2 for z, last in zip(by_claim, self._by_claim, strict=False)]
        if halves and interval < SHORT_INTERVAL:
            horizontal, vertical = self._changes
            self._changes = (
                horizontal.updated(sum(halves[:2]), 2.0, interval),
                vertical.updated(sum(halves[2:]), len(halves) - 2.0, interval),
            )
        self._by_claim = by_claim


def _without(factor: float, share: float, largest: float) -> float:
    """Return a share besides a factor that is in R already, if it is more than was expected."""
    return max(share / factor, largest) if share > largest else share


def horizontal_variance(covariance_n: Array) -> float:
    """Return the mean variance of north and east in a position's covariance (m, m)."""
    return 0.5 * float(covariance_n.item(0, 0) + covariance_n.item(1, 1))


def uncorrected(claimed_std: float) -> float:
    """Return how far a claimed σ [m] is that of a receiver without corrections, 0 to 1."""
    share = (claimed_std - CORRECTED_STD) / (UNCORRECTED_STD - CORRECTED_STD)
    return min(max(share, 0.0), 1.0)
