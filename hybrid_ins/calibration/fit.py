"""
The few numbers that decide how well an IMU and a GNSS receiver work together, from their data.

The filter's innovations have a likelihood for every clock offset, lever arm and noise level; what
makes it largest is the calibration, and how sharply it falls is its uncertainty. Weak priors at
the given parameters hold what the recording does not tell. Innovations are taken to be Student t:
an outlier costs little.

References
----------
.. [1] F. C. Schweppe, "Evaluation of likelihood functions for Gaussian signals", IEEE
       Transactions on Information Theory 11, 1965.
.. [2] H. White, "Maximum likelihood estimation of misspecified models", Econometrica 50, 1982
       (uncertainty from the scores where the model is not quite right).
.. [3] E. Berndt, B. Hall, R. Hall, J. Hausman, "Estimation and inference in nonlinear structural
       models", Annals of Economic and Social Measurement 3, 1974.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.calibration.innovations import POSITION, empty_rows, innovations, log_likelihood
from hybrid_ins.core.earth import curvature_scale, normal_gravity
from hybrid_ins.core.rotations import (
    matrix_from_quat,
    quat_from_matrix,
    quat_from_rotvec,
    quat_from_rpy,
    rotvec_from_quat,
)
from hybrid_ins.core.state import N_ERROR, PSD, NavState

Array = NDArray[np.float64]

TAIL = 8.0  # degrees of freedom of the innovations
INTERVAL = 0.02 - 1e-6  # s, covariance
YAWS = 12  # headings that a run is started with
BANK_STD = 0.3  # rad, of each
YAW_STD = 0.15  # rad, of the best one
TILT_STD = 0.1  # rad
COARSE_PSD_A, COARSE_PSD_G = 2e-2, 1e-5  # (m/s²)²/Hz, (rad/s)²/Hz: broad peaks over the offset
COARSE_STEP = 0.1  # s
LONGEST_COARSE = 90.0  # s of each run
BLOCK = 3.0  # s, over which scores are taken to be dependent
LN10 = math.log(10.0)


@dataclass(frozen=True, eq=False)
class Run:
    """One recording, in arrays."""

    name: str
    t: Array  # (N,) s
    samples: Array  # (N, 6) specific force m/s², angular rate rad/s, b
    aid_t: Array  # (M,) s, reference clock
    aid_kind: NDArray[np.int64]  # (M,) POSITION or VELOCITY
    aid: Array  # (M, 3) rad rad m, or m/s NED
    aid_R: Array  # (M, 3, 3)
    attitude: tuple[Array, Array] | None = None  # (K,) s reference clock, (K, 4) C_nb: truth

    @property
    def period(self) -> float:
        """Median time between IMU samples [s]."""
        return float(np.median(np.diff(self.t)))

    def aided(self, first: float, last: float) -> Run:
        """Keep the measurements of a stretch of the reference's clock [s]."""
        keep = (self.aid_t >= first) & (self.aid_t <= last)
        return replace(
            self,
            aid_t=self.aid_t[keep],
            aid_kind=self.aid_kind[keep],
            aid=self.aid[keep],
            aid_R=self.aid_R[keep],
        )


@dataclass(frozen=True, slots=True)
class Prior:
    """A parameter's name, what it is expected to be, and the step of its finite differences."""

    name: str
    mean: float
    std: float
    step: float


@dataclass(frozen=True, slots=True)
class Given:
    """Where the search starts from, and what is not searched for."""

    time_offset: float  # s
    lever_b: Array  # (3,) m, antenna relative to the IMU
    psd_a: float  # (m/s²)²/Hz
    psd_g: float  # (rad/s)²/Hz
    walk_a: float  # m/s²/√s
    walk_g: float  # rad/s/√s
    bias_a: Array  # (3,) m/s², b
    bias_a_std: Array  # (3,) m/s²
    bias_g: Array  # (3,) rad/s, b
    bias_g_std: Array  # (3,) rad/s


SHARED = ("lever_x", "lever_y", "lever_z", "psd_a", "psd_g", "walk_a", "walk_g", "gnss_scale")


@dataclass(frozen=True, eq=False)
class Fit:
    """What maximises the likelihood; logarithms are natural."""

    names: tuple[str, ...]
    x: Array  # (n,)
    std: Array  # (n,) after the recordings
    prior: tuple[Prior, ...]
    frozen: frozenset[str]  # held at the prior's mean: not identifiable
    yaws: tuple[float, ...]  # rad from north, of each run at its start
    runs: tuple[Run, ...]  # with the measurements that were used
    grid: Array  # (G,) s, offsets of the coarse search
    profile: Array  # (runs, G) log-likelihood
    first: Array  # (n,) before: the given parameters

    def value(self, name: str) -> float:
        """Return one parameter."""
        return float(self.x[self.names.index(name)])

    def sigma(self, name: str) -> float:
        """Return one parameter's standard deviation."""
        return float(self.std[self.names.index(name)])

    def offset(self, run: int) -> float:
        """Return the clock offset of a run [s]."""
        return self.value(offset_name(run, self.names))


def offset_name(run: int, names: Sequence[str]) -> str:
    """Return the name of a run's offset: its own, or that of all."""
    return f"offset_{run}" if f"offset_{run}" in names else "offset"


@dataclass(frozen=True, eq=False)
class Pass:
    """The innovations of one run."""

    z: Array  # (M, 3)
    S: Array  # (M, 3, 3)
    nis: Array  # (M,)
    rows: Array  # (M, N_NAV) or (0, N_NAV)

    @property
    def log_likelihood(self) -> Array:
        """Of each measurement, shape (M,)."""
        return log_likelihood(self.z, self.S, self.nis, TAIL)


def start_state(
    run: Run,
    offset: float,
    lever_b: Array,
    given: Given,
    yaw: float,
    yaw_std: float,
) -> tuple[int, Array]:
    """
    Sample and flat state to start a run with: both sides of the start may be looked at.

    The first fixes give position, velocity and acceleration, outliers among them outvoted; the
    specific force that goes with the acceleration gives the tilt.
    """
    fixes = np.flatnonzero(run.aid_kind == POSITION)
    t_fix = run.aid_t[fixes] + offset
    first = int(np.searchsorted(run.t, t_fix[0]))
    first = min(max(first, 0), len(run.t) - 2)
    now = run.t[first]
    window = fixes[: max(4, int(np.searchsorted(t_fix, now + 1.5)))]
    dt = run.aid_t[window] + offset - now
    origin = run.aid[window[0]].copy()
    height = run.aid[window, 2]
    origin[2] = height[np.isfinite(height)][0] if np.any(np.isfinite(height)) else 0.0
    scale = curvature_scale(origin)
    places = np.nan_to_num((run.aid[window] - origin) * scale)
    order = 2 if len(window) > 3 and np.ptp(dt) > 0.5 else 1
    design = np.vander(dt, order + 1, increasing=True)
    R0 = np.nan_to_num(run.aid_R[window[0]], posinf=1e4)
    coefficients, weights = _outvoted(design, places, np.sqrt(np.diag(R0)))
    spread = np.linalg.pinv((design * weights[:, None]).T @ design)
    position, velocity = coefficients[0], coefficients[1]
    acceleration = 2.0 * coefficients[2] if order == 2 else np.zeros(3)
    acceleration = np.clip(acceleration, -5.0, 5.0)
    near = slice(
        int(np.searchsorted(run.t, now - 0.5)),
        int(np.searchsorted(run.t, now + min(max(dt[-1], 0.5), 1.5))) + 1,
    )
    force_n = acceleration - np.array([0.0, 0.0, normal_gravity(origin[0], origin[2])[1]])
    quat = _levelled(run, near, first, force_n, yaw, given)
    P = np.zeros((N_ERROR, N_ERROR))
    P[:3, :3] = R0 * max(spread[0, 0], 0.2) + 0.05**2 * np.eye(3)
    P[3:6, 3:6] = R0 * spread[1, 1] + 0.5**2 * np.eye(3)
    P[range(6, 15), range(6, 15)] = (
        np.concatenate((np.full(3, TILT_STD), given.bias_a_std, given.bias_g_std)) ** 2
    )
    P[8, 8] = yaw_std**2
    position = position - matrix_from_quat(quat) @ lever_b
    state = NavState(origin + position / scale, velocity, quat, given.bias_a, given.bias_g, P)
    return first, state.to_flat()


def _outvoted(design: Array, places: Array, std: Array) -> tuple[Array, Array]:
    """Coefficients (order + 1, 3) of least absolute residuals, and the rows' weights (K,)."""
    weights: Array = np.ones(len(design))
    for _ in range(20):
        root = np.sqrt(weights)[:, None]
        coefficients = np.linalg.lstsq(root * design, root * places, rcond=None)[0]
        away = np.linalg.norm((places - design @ coefficients) / std, axis=1)
        weights = np.asarray(1.0 / np.maximum(away, 1.5), float)
    return np.asarray(coefficients, float), weights / np.max(weights)


def _levelled(run: Run, near: slice, first: int, f_n: Array, yaw: float, given: Given) -> Array:
    """Attitude at sample ``first`` in which the mean specific force of ``near`` is along f_n."""
    f, w = run.samples[near, :3] - given.bias_a, run.samples[near, 3:] - given.bias_g
    dt = np.diff(run.t[near], prepend=run.t[near][0])
    angle = np.cumsum(w * dt[:, None], axis=0)
    angle -= angle[max(first - near.start, 0)]
    turned = matrix_from_quat(quat_from_rotvec(angle))  # each sample's b to that of the start
    f_b = np.mean(np.einsum("kij,kj->ki", turned, f), axis=0)
    f_b /= np.linalg.norm(f_b)
    f_n = f_n / np.linalg.norm(f_n)
    roll, pitch = math.atan2(-f_b[1], -f_b[2]), math.atan2(f_b[0], math.hypot(f_b[1], f_b[2]))
    C = matrix_from_quat(quat_from_rpy(roll, pitch, yaw))
    up = C @ f_b
    axis = np.cross(up, f_n)
    return quat_from_matrix(matrix_from_quat(quat_from_rotvec(axis)) @ C)


def run_filter(
    run: Run,
    offset: float,
    lever_b: Array,
    psd: Array,
    gnss_scale: float,
    given: Given,
    yaw: float,
    yaw_std: float,
    keep_rows: bool = False,
) -> Pass:
    """
    Run the filter over a recording with the given parameters.

    Parameters
    ----------
    psd : ndarray, shape (12,)
        Qc's diagonal.
    gnss_scale : float
        Factor on the measurements' covariances.
    """
    first, nav = start_state(run, offset, lever_b, given, yaw, yaw_std)
    nav[PSD] = psd
    M = len(run.aid_t)
    result = Pass(
        np.empty((M, 3)), np.empty((M, 3, 3)), np.empty(M), empty_rows(M if keep_rows else 0)
    )
    innovations(
        nav,
        run.t[first:],
        run.samples[first:],
        run.aid_t + offset,
        run.aid_kind,
        run.aid,
        run.aid_R * gnss_scale,
        lever_b,
        INTERVAL,
        TAIL,
        result.z,
        result.S,
        result.nis,
        result.rows,
    )
    return result


class Problem:
    """
    The likelihood of some runs as a function of a parameter vector.

    Parameters
    ----------
    runs : sequence of Run
    given : Given
    own_offsets : bool
        Every run has its own clock offset.
    """

    def __init__(self, runs: Sequence[Run], given: Given, own_offsets: bool) -> None:
        self.runs = list(runs)
        self.given = given
        self.yaws = [0.0] * len(runs)
        offsets = [f"offset_{k}" for k in range(len(runs))] if own_offsets else ["offset"]
        lever = given.lever_b
        self.prior = (
            *(Prior(name, given.time_offset, 1.0, 0.004) for name in offsets),
            *(Prior(name, float(lever[k]), 1.0, 0.01) for k, name in enumerate(SHARED[:3])),
            Prior("psd_a", math.log(given.psd_a), 2.0 * LN10, 0.1),
            Prior("psd_g", math.log(given.psd_g), 2.0 * LN10, 0.1),
            Prior("walk_a", math.log(given.walk_a), 0.7 * LN10, 0.2),
            Prior("walk_g", math.log(given.walk_g), 0.7 * LN10, 0.2),
            Prior("gnss_scale", 0.0, 1.0, 0.05),
        )
        self.names = tuple(p.name for p in self.prior)
        self._at = {name: k for k, name in enumerate(self.names)}
        self.frozen: frozenset[str] = frozenset()
        self.tell: Callable[[], None] = lambda: None

    def value(self, x: Array, name: str) -> float:
        """Return a parameter's value in ``x``."""
        return float(x[self._at[name]])

    def run(self, k: int, x: Array, keep_rows: bool = False) -> Pass:
        """Run the filter over recording ``k`` with parameters ``x``."""
        self.tell()
        return self._filter(k, x, keep_rows)

    def _filter(self, k: int, x: Array, keep_rows: bool = False) -> Pass:
        psd = np.repeat(
            np.exp(
                [
                    self.value(x, "psd_a"),
                    self.value(x, "psd_g"),
                    2.0 * self.value(x, "walk_a"),
                    2.0 * self.value(x, "walk_g"),
                ]
            ),
            3,
        )
        lever = np.array([self.value(x, name) for name in SHARED[:3]])
        return run_filter(
            self.runs[k],
            self.value(x, offset_name(k, self.names)),
            lever,
            psd,
            math.exp(self.value(x, "gnss_scale")),
            self.given,
            self.yaws[k],
            YAW_STD,
            keep_rows,
        )

    def coarse(self, grid: Array) -> Array:
        """Log-likelihood (runs, G) over clock offsets, the heading free; keeps the best heading."""
        profile = np.full((len(self.runs), len(grid)), -np.inf)
        given = self.given
        psd = np.repeat([COARSE_PSD_A, COARSE_PSD_G, given.walk_a**2, given.walk_g**2], 3)
        yaws = np.arange(YAWS) * 2.0 * np.pi / YAWS
        self._bank = np.zeros((len(self.runs), len(grid), YAWS))
        for k, whole in enumerate(self.runs):
            run = whole.aided(whole.aid_t[0], whole.aid_t[0] + LONGEST_COARSE)
            starts = [(offset, yaw) for offset in grid for yaw in yaws]

            def begun(start: tuple[float, float], run: Run = run) -> Pass:
                offset, yaw = start
                return run_filter(run, offset, given.lever_b, psd, 1.0, given, yaw, BANK_STD)

            self._bank[k] = np.reshape(
                [np.sum(p.log_likelihood) for p in self._at_once(begun, starts)], (len(grid), YAWS)
            )
            for g in range(len(grid)):
                best = np.max(self._bank[k, g])
                profile[k, g] = best + math.log(np.mean(np.exp(self._bank[k, g] - best)))
        return profile

    def choose_yaws(self, x: Array, width: float) -> None:
        """Start every run with the heading within ``width`` [rad] of its own that fits best."""
        for k in range(len(self.runs)):
            centre = self.yaws[k]
            candidates = centre + np.linspace(-width, width, 7)
            values = []
            for yaw in candidates:
                self.yaws[k] = float(yaw)
                values.append(np.sum(self.run(k, x).log_likelihood))
            self.yaws[k] = float(candidates[int(np.argmax(values))])

    def take_best_bank(self, grid: Array, offsets: Sequence[float]) -> None:
        """Start every run with the heading that the coarse search found best at its offset."""
        for k, offset in enumerate(offsets):
            g = int(np.argmin(np.abs(grid - offset)))
            self.yaws[k] = float(np.argmax(self._bank[k, g])) * 2.0 * math.pi / YAWS

    # Derivatives: an offset of one run moves no other run.

    def _concerned(self, name: str) -> list[int]:
        if name.startswith("offset_"):
            return [int(name[len("offset_") :])]
        return list(range(len(self.runs)))

    def _free(self) -> list[int]:
        return [k for k, name in enumerate(self.names) if name not in self.frozen]

    def scores(self, x: Array) -> tuple[list[Array], list[Array]]:
        """Log-likelihood (M,) and its derivatives (M, n) of each measurement of each run."""
        steps = [(k, i) for i in self._free() for k in self._concerned(self.names[i])]

        def moved(step: tuple[int, int]) -> Pass:
            k, i = step
            high = x.copy()
            if i >= 0:
                high[i] += self.prior[i].step
            return self._filter(k, high)

        points = [*((k, -1) for k in range(len(self.runs))), *steps]
        found = [passed.log_likelihood for passed in self._at_once(moved, points)]
        values = found[: len(self.runs)]
        slopes = [np.zeros((len(v), len(x))) for v in values]
        for (k, i), high in zip(steps, found[len(self.runs) :], strict=True):
            slopes[k][:, i] = (high - values[k]) / self.prior[i].step
        return values, slopes

    def _at_once(self, call: Callable[[Any], Pass], arguments: Sequence[Any]) -> Iterator[Pass]:
        """Run the filter for each argument, on all processors: it leaves Python's lock."""
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            for passed in pool.map(call, arguments):
                self.tell()
                yield passed

    def value_at(self, x: Array) -> float:
        """Log-posterior."""
        total = sum(float(np.sum(self.run(k, x).log_likelihood)) for k in range(len(self.runs)))
        return total - 0.5 * float(np.sum(self._away(x) ** 2))

    def _away(self, x: Array) -> Array:
        return np.array([(v - p.mean) / p.std for v, p in zip(x, self.prior, strict=True)])

    def slope(self, slopes: Sequence[Array], x: Array) -> Array:
        """Gradient of the log-posterior (n,) from that of each measurement."""
        total = np.sum(np.vstack(slopes), axis=0)
        return np.asarray(total - self._away(x) / [p.std for p in self.prior])

    def maximise(self, x: Array, iterations: int = 15) -> Array:
        """
        Return the parameters of the largest posterior, from ``x`` on.

        Scoring with the scores' own scatter for the information [3]_, damped until it climbs.
        """
        free = self._free()
        reach = np.array([25.0 * self.prior[i].step for i in free])
        prior = np.diag([self.prior[i].std ** -2.0 for i in free])
        value, damping = self.value_at(x), 0.01
        for _ in range(iterations):
            _, slopes = self.scores(x)
            gradient = self.slope(slopes, x)[free]
            rows = np.vstack(slopes)[:, free]
            information = rows.T @ rows + prior
            gained = 0.0
            while damping < 1e4 and gained <= 0.0:
                move = np.linalg.solve(
                    information + damping * np.diag(np.diag(information)), gradient
                )
                y = x.copy()
                y[free] += np.clip(move, -reach, reach)
                there = self.value_at(y)
                gained = there - value if math.isfinite(there) else -math.inf
                damping *= 0.2 if gained > 0.0 else 5.0
            if gained > 0.0:
                x, value = y, there
            if gained < 0.05:
                break
            damping = max(damping, 1e-4)
        return x

    def uncertainty(self, x: Array) -> Array:
        """
        Standard deviations (n,): from the information, or from the scattering scores where larger.

        Each measurement's own score makes the information [3]_; the sums of a few seconds', taken
        as independent, their scatter [2]_.
        """
        free = self._free()
        scatter = np.zeros((len(free), len(free)))
        blocks = 0
        _, slopes = self.scores(x)
        for k, run in enumerate(self.runs):
            label = ((run.aid_t - run.aid_t[0]) // BLOCK).astype(int)
            sums = np.zeros((label[-1] + 1, len(x)))
            np.add.at(sums, label, slopes[k])
            sums = sums[:, free] - sums[:, free].mean(axis=0)
            scatter += sums.T @ sums
            blocks += len(sums)
        prior = np.array([p.std for p in self.prior])
        rows = np.vstack(slopes)[:, free]
        inverse = np.linalg.inv(rows.T @ rows + np.diag(prior[free] ** -2.0))
        variance = np.diag(inverse).copy()
        if blocks > 2 * len(free):
            variance = np.maximum(variance, np.diag(inverse @ scatter @ inverse))
        std = prior.copy()
        std[free] = np.minimum(np.sqrt(variance), prior[free])
        return std


def fit(
    runs: Sequence[Run],
    given: Given,
    *,
    own_offsets: bool,
    search: float,
    useless: dict[str, float],
    held: frozenset[str] = frozenset(),
    tell: Callable[[str], Callable[[], None]],
) -> Fit:
    """
    Calibrate some runs jointly.

    Parameters
    ----------
    runs : sequence of Run
    given : Given
    own_offsets : bool
        A clock offset for each run.
    search : float
        Offsets within this of the given one are searched [s].
    useless : dict
        Standard deviation from which a parameter is held at its given value, by name.
    held : frozenset of str
        Parameters that are not searched for at all.
    tell : callable
        Given a stage's name, returns what to call with every filter run.

    Returns
    -------
    Fit
    """
    centre = given.time_offset
    reach = round(search / COARSE_STEP)
    grid = np.asarray(centre + COARSE_STEP * np.arange(-reach, reach + 1), np.float64)
    problem = Problem([_within(run, centre, search) for run in runs], given, own_offsets)
    problem.tell = tell("coarse")
    profile = problem.coarse(grid)
    if own_offsets:
        offsets = [float(grid[np.argmax(row)]) for row in profile]
    else:
        offsets = [float(grid[np.argmax(profile.sum(axis=0))])] * len(runs)
    bank, problem = (
        problem,
        Problem(
            [_within(run, o, 2.0 * COARSE_STEP) for run, o in zip(runs, offsets, strict=True)],
            given,
            own_offsets,
        ),
    )
    bank.take_best_bank(grid, offsets)
    problem.yaws = bank.yaws
    problem.tell = tell("fine")
    first = np.array([p.mean for p in problem.prior])
    x = first.copy()
    for k, offset in enumerate(offsets):
        x[problem.names.index(offset_name(k, problem.names))] = offset
    x[problem.names.index("psd_a")] = math.log(COARSE_PSD_A)
    x[problem.names.index("psd_g")] = math.log(COARSE_PSD_G)
    problem.choose_yaws(x, math.pi / YAWS)
    problem.frozen = held | {"walk_a", "walk_g"}
    x = problem.maximise(x)
    problem.choose_yaws(x, 0.1)
    problem.frozen = held
    x = problem.maximise(x)
    std = problem.uncertainty(x)
    limits = np.array(
        [
            useless.get("offset" if name.startswith("offset") else name, math.inf)
            for name in problem.names
        ]
    )
    keep = np.array([name in held for name in problem.names])
    while np.any((std > limits) & ~keep):  # held at its value, one may show another to be useless
        keep |= std > limits
        problem.frozen = frozenset(np.array(problem.names)[keep].tolist())
        x = problem.maximise(np.where(keep, first, x))
        std = np.where(keep, std, problem.uncertainty(x))
    return Fit(
        problem.names,
        x,
        std,
        problem.prior,
        problem.frozen,
        tuple(problem.yaws),
        tuple(problem.runs),
        grid,
        profile,
        first,
    )


def passes(fitted: Fit, given: Given, x: Array) -> list[Pass]:
    """Run the filter over all recordings with parameters ``x`` and keep the states."""
    problem = Problem(fitted.runs, given, "offset" not in fitted.names)
    problem.yaws = list(fitted.yaws)
    return [problem.run(k, x, keep_rows=True) for k in range(len(problem.runs))]


def _within(run: Run, offset: float, margin: float) -> Run:
    """Keep the measurements that lie within the samples for all offsets near ``offset``."""
    return run.aided(run.t[0] - offset + margin, run.t[-1] - offset - margin)


def mean_rotation(quats_xyzw: Array) -> tuple[Array, float]:
    """Mean of rotations (K, 4) as a matrix, and their spread [rad]."""
    M = np.mean(matrix_from_quat(quats_xyzw), axis=0)
    u, _, vt = np.linalg.svd(M)
    C = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    away = rotvec_from_quat(quat_from_matrix(matrix_from_quat(quats_xyzw) @ C.T))
    return C, float(np.sqrt(np.mean(np.sum(away**2, axis=-1))))
