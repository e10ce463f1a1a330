"""
Maximum-likelihood estimation of clock offset, lever arm and noise levels from recordings.

References
----------
.. [1] H. White, "Maximum likelihood estimation of misspecified models", Econometrica 50, 1982
       (uncertainty from the scores where the model is not exact).
.. [2] E. Berndt, B. Hall, R. Hall, J. Hausman, "Estimation and inference in nonlinear structural
       models", Annals of Economic and Social Measurement 3, 1974.
.. [3] S. F. Schmidt, "Application of state-space methods to navigation problems", Advances in
       Control Systems 3, 1966 (parameters that are considered).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.calibration.ascent import climb, maximise, settle_offsets
from hybrid_ins.calibration.drift import Drift, remove_drift
from hybrid_ins.calibration.filter_pass import FilterPass, Model, Nominal
from hybrid_ins.calibration.findings import kept_below
from hybrid_ins.calibration.innovations import VELOCITY
from hybrid_ins.calibration.likelihood import (
    COARSE_PSD_A,
    COARSE_PSD_G,
    COARSE_SLOW,
    LEVER,
    SCALE,
    SLOW_SHARE,
    VELOCITY_AGE,
    VELOCITY_AGES,
    VELOCITY_SCALE,
    YAWS,
    Likelihood,
    Prior,
    holding,
    model_by,
    offset_name,
    sums_of_blocks,
)
from hybrid_ins.calibration.motion import std_by_motion
from hybrid_ins.calibration.recording import Recording

Array = NDArray[np.float64]
OnStage = Callable[[str], Callable[[], None]]  # given a stage's name, returns what counts passes

COARSE_STEP = 0.1  # s
DIFFERENT = 5.0  # standard deviations: σ is of a model that is only nearly right, and a weak
# antenna's height was 3.9 σ off
CLOCK_DIFFERENT = 3.0  # likewise, of clock offsets: with a wrong one all else is wrong, too
CONFIRMED = "as given: the motion agrees with it"
KEPT, CLOCK_KEPT = kept_below(DIFFERENT), kept_below(CLOCK_DIFFERENT)


@dataclass(frozen=True, eq=False)
class Fit:
    """The most probable parameters; logarithms are natural."""

    names: tuple[str, ...]
    x: Array  # (n,)
    std: Array  # (n,) posterior; of what is held: root of the mean square of its error
    prior: tuple[Prior, ...]
    frozen: frozenset[str]  # held at the mean of the prior: not identifiable
    yaws: tuple[float, ...]  # rad from north, of each recording at its start
    recordings: tuple[Recording, ...]  # with the measurements that were used, and no drift
    grid: Array  # (G,) s, offsets of the coarse search
    profile: Array  # (recordings, G) log-likelihood
    nominal_x: Array  # (n,) the nominal parameters
    converged: bool
    errors: Array  # (K, n) that go together, from each parameter that is held
    drift: Drift = Drift(0.0, math.inf)  # noqa: RUF009  of the clock, removed from the recordings

    def value(self, name: str) -> float:
        """Return one parameter."""
        return float(self.x[self.names.index(name)])

    def sigma(self, name: str) -> float:
        """Return the standard deviation of one parameter."""
        return float(self.std[self.names.index(name)])

    @property
    def model(self) -> Model:
        """What the filter runs with."""
        return model_by(self.value)

    def offset(self, recording: int) -> float:
        """Return the clock offset of a recording [s]."""
        return self.value(offset_name(recording, self.names))


def fit(
    recordings: Sequence[Recording],
    nominal: Nominal,
    *,
    own_offsets: bool,
    search: float,
    identified_std: Mapping[str, float],
    held: frozenset[str] = frozenset(),
    probable: Mapping[str, float] = MappingProxyType({}),
    on_stage: OnStage,
) -> Fit:
    """
    Estimate the parameters of some recordings jointly.

    Parameters
    ----------
    recordings : sequence of Recording
    nominal : Nominal
    own_offsets : bool
        A clock offset for each recording.
    search : float
        Offsets within this of the nominal one are searched [s].
    identified_std : mapping
        Standard deviation up to which a parameter is identified, by name. Above it, a parameter
        that differs from its nominal value by less than ``DIFFERENT`` standard deviations, a clock
        offset by less than ``CLOCK_DIFFERENT``, is held there: the others are then those that go
        with the value that is kept.
    held : frozenset of str
        Parameters that are not estimated.
    probable : mapping
        Parameters whose nominal value may well be exact: for each by how many standard deviations
        it has to differ from that not to be held there.
    on_stage : callable
        Given a stage's name, returns what to call after every pass of the filter.

    Returns
    -------
    Fit
    """
    centre = nominal.time_offset
    reach = round(search / COARSE_STEP)
    if not any(np.any(recording.aid_kind == VELOCITY) for recording in recordings):
        held |= {VELOCITY_AGE, VELOCITY_SCALE}
    grid = np.asarray(centre + COARSE_STEP * np.arange(-reach, reach + 1), np.float64)
    coarse = Likelihood([kept_within(r, centre, search) for r in recordings], nominal, own_offsets)
    coarse.on_pass = on_stage("coarse")
    profile = coarse.coarse(grid)
    if own_offsets:
        offsets = [float(grid[np.argmax(row)]) for row in profile]
    else:
        offsets = [float(grid[np.argmax(profile.sum(axis=0))])] * len(recordings)
    coarse.choose_coarse_yaws(grid, offsets)

    fine = Likelihood(
        [kept_within(r, o, 2.0 * COARSE_STEP) for r, o in zip(recordings, offsets, strict=True)],
        nominal,
        own_offsets,
    )
    fine.yaws = coarse.yaws
    fine.on_pass = on_stage("fine")
    nominal_x = np.array([p.mean for p in fine.prior])
    x = nominal_x.copy()
    for k, offset in enumerate(offsets):
        x[fine.names.index(offset_name(k, fine.names))] = offset
    x[fine.names.index("psd_a")] = math.log(COARSE_PSD_A)
    x[fine.names.index("psd_g")] = math.log(COARSE_PSD_G)
    if SLOW_SHARE not in held:
        x[fine.names.index(SLOW_SHARE)] = math.log(COARSE_SLOW)
    fine.choose_yaws(x, math.pi / YAWS)
    if VELOCITY_AGE not in held:
        age = fine.likeliest(x, VELOCITY_AGE, VELOCITY_AGES)
        x[fine.names.index(VELOCITY_AGE)] = age
    held |= set(SCALE) & set(fine.names)
    fine.frozen = held
    with holding(fine, held | {"walk_a", "walk_g"}):
        x, _ = climb(fine, x)
    fine.choose_yaws(x, 0.1)
    x, converged = settle_offsets(fine, *climb(fine, x))
    x = _beside_scale(fine, x)
    std = own = uncertainty(fine, x)
    known = _by_name(fine.names, identified_std)
    keep = np.array([name in held for name in fine.names])
    is_clock = np.array([name.startswith("offset") for name in fine.names])
    different = np.where(is_clock, CLOCK_DIFFERENT, DIFFERENT)
    apart = np.array([probable.get(name, 0.0) for name in fine.names])
    decided = np.zeros(len(x), bool)
    while True:  # holding one parameter may reveal another as weak
        weak = (std > known) & (np.abs(x - nominal_x) < different * std)
        weak |= np.abs(x - nominal_x) < apart * std
        weak &= ~decided
        decided = is_clock  # with all else free: what is held next draws the clock to it
        if np.all(keep | weak == keep):
            break
        std = np.where(weak & ~keep, np.hypot(std, x - nominal_x), std)
        keep |= weak
        fine.frozen = frozenset(np.array(fine.names)[keep].tolist())
        x, converged = _ascend(fine, np.where(keep, nominal_x, x))
        own = np.where(keep, std, uncertainty(fine, x))
        std = _considered(fine, own, _errors_of_held(fine, x, own, "offset", "lever"))
    drift = Drift(0.0, math.inf)
    if all(std[i] <= known[i] for i in fine.offsets):
        x, refitted, drift = remove_drift(fine, x, partial(_ascend, fine))
    if drift.value:
        converged = refitted
        own = np.where(keep, std, uncertainty(fine, x))
    errors = _errors_of_held(fine, x, own, "offset", "lever")
    return Fit(
        fine.names,
        x,
        _considered(fine, own, errors),
        fine.prior,
        fine.frozen,
        tuple(fine.yaws),
        tuple(fine.recordings),
        grid,
        profile,
        nominal_x,
        converged,
        errors,
        drift,
    )


def _ascend(likelihood: Likelihood, x: Array) -> tuple[Array, bool]:
    """Return what `maximise` does, and then `_beside_scale`."""
    x, converged = maximise(likelihood, x)
    return _beside_scale(likelihood, x), converged


def _beside_scale(likelihood: Likelihood, x: Array) -> Array:
    """
    Return ``x`` with clocks and lever arm as they are beside errors of the IMU's scale factors.

    In turns, and where the vehicle tilts, these do something similar. The noise stays that of a
    filter that ignores them, and they are zero in what is returned: nobody would correct the IMU.
    """
    names = likelihood.names
    if not set(SCALE) & set(names):
        return x
    varied = {names[i] for i in likelihood.offsets} | {*LEVER, VELOCITY_AGE}
    with holding(likelihood, (likelihood.frozen | set(names) - varied) - set(SCALE)):
        beside, _ = maximise(likelihood, x)
    return np.array([0.0 if n in SCALE else v for n, v in zip(names, beside, strict=True)])


def _by_name(names: Sequence[str], limits: Mapping[str, float]) -> Array:
    """Return a limit for each parameter; infinite where there is none."""
    return np.array(
        [limits.get("offset" if n.startswith("offset") else n, math.inf) for n in names]
    )


def uncertainty(likelihood: Likelihood, x: Array) -> Array:
    """
    Return standard deviations (n,): from the information or, where larger, from the scores.

    The outer products of the scores of single measurements are the information [2]_; those of
    sums over a few seconds, assumed to be independent, are the covariance of the scores [1]_.
    That of a clock offset is no smaller than what the motion shows of it, nor that of an antenna's
    place than what it shows of the direction of its arm. Scale errors of the IMU are unknown.
    """
    with holding(likelihood, likelihood.frozen - set(SCALE)):
        free = likelihood.free()
        _, slopes = likelihood.scores(x)
    scatter = np.zeros((len(free), len(free)))
    blocks = 0
    for k, recording in enumerate(likelihood.recordings):
        sums = sums_of_blocks(recording, slopes[k])
        sums = sums[:, free] - sums[:, free].mean(axis=0)
        scatter += sums.T @ sums
        blocks += len(sums)
    prior = np.array([p.std for p in likelihood.prior])
    rows = np.vstack(slopes)[:, free]
    inverse = np.linalg.inv(rows.T @ rows + np.diag(prior[free] ** -2.0))
    variance = np.diag(inverse).copy()
    if blocks > 2 * len(free):
        variance = np.maximum(variance, np.diag(inverse @ scatter @ inverse))
    std = prior.copy()
    std[free] = np.sqrt(variance)
    for i in set(likelihood.offsets) & set(free):
        std[i] = max(std[i], _std_by_motion(likelihood, x, likelihood.names[i]))
    arm = [likelihood.names.index(name) for name in LEVER[:2]]
    if set(arm) & set(free):
        across = np.abs(x[arm[::-1]]) * likelihood.azimuth_std(x)
        std[arm] = np.where(np.isin(arm, free), np.hypot(std[arm], across), std[arm])
    return np.minimum(std, prior)


def _errors_of_held(likelihood: Likelihood, x: Array, std: Array, *held: str) -> Array:
    """
    Return errors (K, n) of the parameters, one row for each that is held, maybe wrongly.

    These are the frozen ones whose names begin with one of ``held``; ``std`` (n,) has how wrong
    they may be. The parameters of the largest posterior move with what is held by the information
    on both, [3]_.
    """
    free, frozen = likelihood.free(), likelihood.frozen
    wrong = [k for k, n in enumerate(likelihood.names) if n in frozen and n.startswith(held)]
    errors = np.zeros((len(wrong), len(x)))
    if wrong:
        with holding(likelihood, frozen - {likelihood.names[k] for k in wrong}):
            rows = np.vstack(likelihood.scores(x)[1])
        precision = np.array([p.std for p in likelihood.prior]) ** -2.0
        information = rows.T @ rows + np.diag(precision)
        moved = np.linalg.solve(information[np.ix_(free, free)], information[np.ix_(free, wrong)])
        errors[:, free] = -moved.T * std[wrong, None]
        errors[range(len(wrong)), wrong] = std[wrong]
    return errors


def _considered(likelihood: Likelihood, std: Array, errors: Array) -> Array:
    """Return standard deviations (n,) of what is free with the errors (K, n) of what is held."""
    total, free = std.copy(), likelihood.free()
    total[free] = np.hypot(std[free], np.linalg.norm(errors[:, free], axis=0))
    return np.minimum(total, [p.std for p in likelihood.prior])


def _std_by_motion(likelihood: Likelihood, x: Array, offset: str) -> float:
    """Return the standard deviation [s] of a clock offset by the motion alone."""
    count = range(len(likelihood.recordings))
    of_clock = [k for k in count if offset_name(k, likelihood.names) == offset]
    passes = [likelihood.run(k, x, keep_states=True) for k in of_clock]
    return std_by_motion(passes, [likelihood.recordings[k] for k in of_clock])


def filter_passes(fitted: Fit, nominal: Nominal, x: Array) -> list[FilterPass]:
    """Run the filter over all recordings with parameters ``x`` and keep the states."""
    likelihood = Likelihood(fitted.recordings, nominal, "offset" not in fitted.names)
    likelihood.yaws = list(fitted.yaws)
    return [likelihood.run(k, x, keep_states=True) for k in range(len(likelihood.recordings))]


def kept_within(recording: Recording, offset: float, margin: float) -> Recording:
    """
    Keep the measurements that lie within the samples for all offsets near ``offset``.

    Velocities lie behind the first position, where the filter starts, and within the samples at any
    age: a likelihood of fewer measurements is not one to compare with.
    """
    first, last = recording.t[0] - offset + margin, recording.t[-1] - offset - margin
    kept = recording.with_measurements_between(first, last)
    is_velocity = kept.aid_kind == VELOCITY
    start = np.min(kept.aid_t[~is_velocity], initial=last) + kept.period
    earliest, latest = kept.aid_t + VELOCITY_AGES[0], kept.aid_t + VELOCITY_AGES[-1]
    return kept.only(~is_velocity | ((earliest > start) & (latest <= last)))
