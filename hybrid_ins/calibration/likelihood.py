"""
The likelihood of recordings as a function of clock offset, lever arm and noise levels.

The innovations of the filter have a density for every value of the parameters [1]_. They are
assumed to be Student-t distributed, so that outliers have little influence. Weak priors at the
nominal parameters determine what the recordings do not.

References
----------
.. [1] F. C. Schweppe, "Evaluation of likelihood functions for Gaussian signals", IEEE
       Transactions on Information Theory 11, 1965.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.calibration.filter_pass import (
    FilterPass,
    FirstState,
    Model,
    Nominal,
    first_state,
    run_filter,
)
from hybrid_ins.calibration.innovations import POSITION
from hybrid_ins.calibration.recording import Recording
from hybrid_ins.core.sensor_errors.clock_offset import VELOCITY_AGE_STD
from hybrid_ins.core.sensor_errors.lever_arm import PRIOR_STD
from hybrid_ins.core.sensor_errors.scale_errors import SHARES

Array = NDArray[np.float64]

LEVER = ("lever_x", "lever_y", "lever_z")
GIVEN_STD = 1.0  # m, of each component of a lever arm that was given
SLOW_SHARE = "gnss_slow"  # logarithm of the slow error's share of the claimed variance of positions
POSITION_SCALE, VELOCITY_SCALE = "position_scale", "velocity_scale"  # logarithms, of covariances
VELOCITY_AGE = "velocity_age"  # s, how much younger velocities are than positions with their stamp
VELOCITY_AGES = np.linspace(-0.4, 0.2, 13)
SCALE = tuple(f"scale_{sensor}_{i}{j}" for sensor, i, j in product("ag", "xyz", "xyz"))
"""Elements of M_a and M_g, see `scale_errors`."""
FOLLOW = ("follow_a", "follow_g")  # powers of the loudness of the samples
YAWS = 12  # headings that the coarse search starts with
COARSE_YAW_STD = 0.3  # rad, of each
YAW_STD = 0.15  # rad, of the chosen one
LITTLE_SLOW, COARSE_SLOW = 0.01, 0.1  # share of the claimed variance of positions
COARSE_PSD_A, COARSE_PSD_G = 2e-2, 1e-5  # (m/s²)²/Hz, (rad/s)²/Hz: broad peaks over the offset
LONGEST_COARSE = 90.0  # s of each recording
AZIMUTH_STEP = 0.1  # rad, by which the antenna's arm is turned
SCORE_BLOCK = 3.0  # s, over which scores are assumed to be dependent
OFFSET_STEP = 0.008  # s, of its finite differences at the least: a few samples
FORWARD, CENTRAL = (1.0,), (-1.0, 1.0)  # steps, at which finite differences are taken
LN10 = math.log(10.0)


@dataclass(frozen=True, slots=True)
class Prior:
    """The prior of a parameter, and the step of its finite differences."""

    name: str
    mean: float
    std: float
    step: float


def sums_of_blocks(recording: Recording, scores: Array) -> Array:
    """Return the sums (B, n) of the scores (M, n) of measurements over ``SCORE_BLOCK``."""
    block = ((recording.aid_t - recording.aid_t[0]) // SCORE_BLOCK).astype(int)
    sums = np.zeros((block[-1] + 1, scores.shape[1]))
    np.add.at(sums, block, scores)
    return sums


def model_by(value: Callable[[str], float]) -> Model:
    """Return the filter's model by the values of the parameters, of which ``value`` finds one."""
    noise = value("psd_a"), value("psd_g"), 2.0 * value("walk_a"), 2.0 * value("walk_g")
    return Model(
        np.array([value(name) for name in LEVER]),
        np.repeat(np.exp(noise), 3),
        (value(FOLLOW[0]), value(FOLLOW[1])),
        math.exp(value(POSITION_SCALE)),
        math.exp(value(VELOCITY_SCALE)),
        math.exp(value(SLOW_SHARE)),
        value(VELOCITY_AGE),
    )


def _without_scale_errors(recording: Recording, m: Array) -> Recording:
    """Return a recording whose samples lack scale errors, shape (18,) or (0,)."""
    if not m.any():
        return recording
    samples = recording.samples.copy()
    for sensor, M in zip((slice(0, 3), slice(3, 6)), m.reshape(2, 3, 3), strict=True):
        samples[:, sensor] -= recording.samples[:, sensor] @ M.T
    return replace(recording, samples=samples)


def offset_name(recording: int, names: Sequence[str]) -> str:
    """Return the name of a recording's clock offset: its own, or the common one."""
    return f"offset_{recording}" if f"offset_{recording}" in names else "offset"


class Likelihood:
    """
    The log-posterior of some recordings as a function of a parameter vector.

    Parameters
    ----------
    recordings : sequence of Recording
    nominal : Nominal
    own_offsets : bool
        Every recording has its own clock offset.

    Attributes
    ----------
    yaws : list of float
        Heading [rad] at the start of each recording.
    offsets : range
        Indices of the clock offsets.
    frozen : frozenset of str
        Names of parameters that are not varied.
    on_pass : callable
        Called after every pass of the filter.
    """

    def __init__(
        self, recordings: Sequence[Recording], nominal: Nominal, own_offsets: bool
    ) -> None:
        self.recordings = list(recordings)
        self.nominal = nominal
        self.yaws = [0.0] * len(recordings)
        offsets = [f"offset_{k}" for k in range(len(recordings))] if own_offsets else ["offset"]
        std = GIVEN_STD if nominal.antenna_is_given else PRIOR_STD
        self.period = max(recording.period for recording in recordings)
        step = self.period * math.ceil(OFFSET_STEP / self.period)
        scale_stds = (nominal.scale_std * SHARES).tolist()
        self.prior = (
            *(Prior(name, nominal.time_offset, 1.0, step) for name in offsets),
            *(Prior(n, x, std, 0.01) for n, x in zip(LEVER, nominal.lever_b.tolist(), strict=True)),
            Prior("psd_a", math.log(nominal.psd_a), 2.0 * LN10, 0.1),
            Prior("psd_g", math.log(nominal.psd_g), 2.0 * LN10, 0.1),
            Prior("walk_a", math.log(nominal.walk_a), 0.7 * LN10, 0.2),
            Prior("walk_g", math.log(nominal.walk_g), 0.7 * LN10, 0.2),
            *(Prior(name, 0.0, 1.0, 0.05) for name in FOLLOW),
            *(Prior(name, 0.0, 1.0, 0.05) for name in (POSITION_SCALE, VELOCITY_SCALE)),
            Prior(SLOW_SHARE, math.log(LITTLE_SLOW), 2.0 * LN10, 0.1),
            Prior(VELOCITY_AGE, 0.0, VELOCITY_AGE_STD, 0.001),
            *(Prior(n, 0.0, s, 0.2 * s) for n, s in zip(SCALE, scale_stds, strict=True) if s),
        )
        self.names = tuple(p.name for p in self.prior)
        self._at = {name: k for k, name in enumerate(self.names)}
        self.offsets = range(len(offsets))
        self._scale = [self._at[name] for name in SCALE if name in self._at]
        # Where the IMU is shaken the likelihood of an offset has the period of the samples. That of
        # an antenna may be many times narrower than its step, and information leads nowhere then.
        self._differences = [
            CENTRAL if i in self.offsets or name in LEVER else FORWARD
            for i, name in enumerate(self.names)
        ]
        self._is_forward = np.array([ends is FORWARD for ends in self._differences])
        self.frozen: frozenset[str] = frozenset()
        self._by_yaw: list[Array] = []  # (G, YAWS) of the coarse search, by recording
        self.on_pass: Callable[[], None] = lambda: None
        self._last: tuple[object, list[Array]] | None = None  # a point, and `_values` there
        # A search moves one parameter at a time: most passes begin as the last one did.
        kept = lru_cache(4 * len(recordings))
        self._first_state = kept(self._find_first_state)
        self._noise = kept(lambda k, *follow: self.recordings[k].noise(*follow))

    def _find_first_state(self, k: int, offset: float) -> FirstState:
        return first_state(self.recordings[k], offset, self.nominal)

    def use(self, recordings: Sequence[Recording]) -> None:
        """Replace the recordings by others of the same motions."""
        self.recordings, self._last = list(recordings), None
        self._first_state.cache_clear()
        self._noise.cache_clear()

    def value(self, x: Array, name: str) -> float:
        """Return a parameter's value in ``x``."""
        return float(x[self._at[name]])

    def run(self, k: int, x: Array, keep_states: bool = False) -> FilterPass:
        """Run the filter over recording ``k`` with parameters ``x``."""
        self.on_pass()
        return self._run(k, x, self.yaws[k], keep_states)

    def _run(self, k: int, x: Array, yaw: float, keep_states: bool = False) -> FilterPass:
        model = model_by(partial(self.value, x))
        first = self._first_state(k, self.value(x, offset_name(k, self.names)))
        noise = self._noise(k, *model.follow)
        right = _without_scale_errors(self.recordings[k], x[self._scale])
        return run_filter(right, first, model, noise, yaw, YAW_STD, keep_states)

    def coarse(self, grid: Array) -> Array:
        """Return the log-likelihood (recordings, G) over clock offsets, averaged over headings."""
        profile = np.full((len(self.recordings), len(grid)), -np.inf)
        for k, whole in enumerate(self.recordings):
            begin = whole.begin_of_motion(LONGEST_COARSE)
            moving = whole.with_measurements_between(begin, begin + LONGEST_COARSE)
            self._by_yaw.append(self._coarse(moving, grid))
            for g in range(len(grid)):
                best = np.max(self._by_yaw[k][g])
                profile[k, g] = best + math.log(np.mean(np.exp(self._by_yaw[k][g] - best)))
        return profile

    def _coarse(self, whole: Recording, grid: Array) -> Array:
        """
        Return the log-likelihood (G, YAWS) over clock offsets and headings at the start.

        It is that of positions: velocities may have another age.
        """
        recording = whole.only(whole.aid_kind == POSITION)
        nominal = self.nominal
        psd = np.repeat([COARSE_PSD_A, COARSE_PSD_G, nominal.walk_a**2, nominal.walk_g**2], 3)
        yaws = np.arange(YAWS) * 2.0 * np.pi / YAWS
        model = Model(nominal.lever_b, psd)
        noise = recording.noise(*model.follow)

        def run(start: tuple[FirstState, float]) -> FilterPass:
            first, yaw = start
            return run_filter(recording, first, model, noise, yaw, COARSE_YAW_STD)

        starts = product((first_state(recording, o, nominal) for o in grid), yaws)
        found = [np.sum(p.log_likelihood) for p in self._in_parallel(run, starts)]
        return np.reshape(found, (len(grid), YAWS))

    def profile(self, x: Array, name: str, values: Array) -> Array:
        """Return the log-likelihood of values (G,) of one parameter, the others being ``x``."""
        candidates = np.tile(x, (len(values), 1))
        candidates[:, self._at[name]] = values
        runs = product(candidates, self._affected_recordings(name))
        found = self._in_parallel(lambda run: self._run(run[1], run[0], self.yaws[run[1]]), runs)
        totals = np.reshape([np.sum(p.log_likelihood) for p in found], (len(candidates), -1))
        return np.asarray(totals.sum(axis=1))

    def likeliest(self, x: Array, name: str, values: Array) -> float:
        """Return the likeliest of some values of one parameter, the others being ``x``."""
        return float(values[int(np.argmax(self.profile(x, name, values)))])

    def azimuth_std(self, x: Array) -> float:
        """
        Return the standard deviation [rad] of the direction of the antenna's arm about b's z axis.

        To a vehicle that turns on the spot another direction is another heading. So that is turned
        back at the start, by as much as the arm is turned: its prior is no information on the arm.
        """
        place = [self._at[name] for name in LEVER[:2]]

        def turned(run: tuple[float, int]) -> FilterPass:
            angle, k = run
            there, (cos, sin) = x.copy(), (math.cos(angle), math.sin(angle))
            there[place] = np.array([[cos, -sin], [sin, cos]]) @ x[place]
            return self._run(k, there, self.yaws[k] - angle)

        runs = product((AZIMUTH_STEP, -AZIMUTH_STEP), range(len(self.recordings)))
        beside = sum(float(np.sum(p.log_likelihood)) for p in self._in_parallel(turned, runs))
        lost = sum(float(np.sum(values)) for values in self._values(x)) - 0.5 * beside
        return AZIMUTH_STEP / math.sqrt(2.0 * lost) if lost > 0.0 else math.inf

    def choose_yaws(self, x: Array, width: float) -> None:
        """Set each heading to the most likely one within ``width`` [rad] of it."""
        for k in range(len(self.recordings)):
            candidates = (self.yaws[k] + np.linspace(-width, width, 7)).tolist()

            def run(yaw: float, k: int = k) -> FilterPass:
                return self._run(k, x, yaw)

            values = [np.sum(p.log_likelihood) for p in self._in_parallel(run, candidates)]
            self.yaws[k] = candidates[int(np.argmax(values))]

    def choose_coarse_yaws(self, grid: Array, offsets: Sequence[float]) -> None:
        """Set each heading to the most likely one of the coarse search at its offset."""
        for k, offset in enumerate(offsets):
            if self.recordings[k].begin_of_motion(LONGEST_COARSE) > self.recordings[k].aid_t[0]:
                by_yaw = self._coarse(self.recordings[k], np.array([offset]))[0]
            else:
                by_yaw = self._by_yaw[k][int(np.argmin(np.abs(grid - offset)))]
            self.yaws[k] = float(np.argmax(by_yaw)) * 2.0 * math.pi / YAWS

    # The clock offset of one recording does not affect the others.

    def _affected_recordings(self, name: str) -> list[int]:
        if name.startswith("offset_"):
            return [int(name[len("offset_") :])]
        return list(range(len(self.recordings)))

    def free(self) -> list[int]:
        """Return the indices of the parameters that are varied."""
        return [k for k, name in enumerate(self.names) if name not in self.frozen]

    def scores(self, x: Array) -> tuple[list[Array], list[Array]]:
        """Return log-likelihood (M,) and gradient (M, n) of the measurements, by recording."""
        ends = [
            (k, i, end)
            for i in self.free()
            for k in self._affected_recordings(self.names[i])
            for end in self._differences[i]
        ]

        def moved(step: tuple[int, int, float]) -> FilterPass:
            k, i, end = step
            there = x.copy()
            there[i] += end * self.prior[i].step
            return self._run(k, there, self.yaws[k])

        values = self._values(x)
        found = [passed.log_likelihood for passed in self._in_parallel(moved, ends)]
        slopes = [np.zeros((len(v), len(x))) for v in values]
        for (k, i, end), there in zip(ends, found, strict=True):
            weight = 1.0 / (end * self.prior[i].step * len(self._differences[i]))
            slopes[k][:, i] += weight * (there - values[k])
        return values, slopes

    def _values(self, x: Array) -> list[Array]:
        """Return the log-likelihood (M,) of the measurements, by recording."""
        point = (x.tobytes(), tuple(self.yaws))
        if self._last is None or self._last[0] != point:  # a search asks for its last point again
            count = range(len(self.recordings))
            passes = self._in_parallel(lambda k: self._run(k, x, self.yaws[k]), count)
            self._last = point, [passed.log_likelihood for passed in passes]
        return self._last[1]

    def _in_parallel(
        self, call: Callable[[Any], FilterPass], arguments: Iterable[Any]
    ) -> Iterator[FilterPass]:
        """Run the filter for each argument in threads: the compiled pass releases the GIL."""
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            for passed in pool.map(call, arguments):
                self.on_pass()
                yield passed

    def value_at(self, x: Array) -> float:
        """Return the log-posterior."""
        total = sum(float(np.sum(values)) for values in self._values(x))
        return total - 0.5 * float(np.sum(self._from_prior(x) ** 2))

    def _from_prior(self, x: Array) -> Array:
        """Return the distances from the prior means in standard deviations."""
        return np.array([(v - p.mean) / p.std for v, p in zip(x, self.prior, strict=True)])

    def gradient(self, slopes: Sequence[Array], x: Array) -> Array:
        """
        Return the gradient (n,) of the log-posterior from those of the measurements.

        Differences over a step are the slopes at its middle; the information leads back from there.
        """
        rows = np.vstack(slopes)
        middle = 0.5 * np.array([p.step for p in self.prior]) * self._is_forward
        total = np.sum(rows, axis=0) + middle * np.sum(rows**2, axis=0)
        return np.asarray(total - self._from_prior(x) / [p.std for p in self.prior])


@contextmanager
def holding(likelihood: Likelihood, names: Iterable[str]) -> Iterator[None]:
    """Vary all parameters but those of these names, until the block ends."""
    before, likelihood.frozen = likelihood.frozen, frozenset(names)
    try:
        yield
    finally:
        likelihood.frozen = before
