"""
Paired Monte Carlo runs of the filter under chosen process noise, on arrays and with exact truth.

A `Scenario` draws a `Run` from a seed: a flight, what its IMU and receiver report, and the error
that the filter begins with, drawn from the covariance it is told. Each `Method` of setting the
process noise then flies the same run, so that differences between methods are theirs alone. What
the estimator does around the filter (the regressor on its clock of stamps, the fallback while it
cannot tell) is done here too; alignment and gate are left out, since the start is known and no
simulated fix is an outlier.

References
----------
.. [1] B. Or, I. Klein, "A hybrid model and learning-based adaptive navigation filter", IEEE TIM
       2022, Table I, eq. (16)-(19), (25), (26).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hybrid_ins import parameters
from hybrid_ins.core.filter.events import NoiseChange
from hybrid_ins.core.filter.filter_noise import FilterNoise
from hybrid_ins.core.filter.filter_settings import FilterSettings
from hybrid_ins.core.filter.ins_filter import InsFilter
from hybrid_ins.core.imu.samples import ImuRing
from hybrid_ins.core.inertial.earth import curvature_scale
from hybrid_ins.core.inertial.rotations import (
    left_jacobian,
    quat_conjugate,
    quat_multiply,
    rotvec_from_quat,
)
from hybrid_ins.core.inertial.state import DP, N_ERROR, NavState
from hybrid_ins.core.noise.innovation import InnovationNoise
from hybrid_ins.core.noise.multiple_model import NoiseMultipleModelBank
from hybrid_ins.core.noise.process_noise import (
    PAPER_CONSTANTS,
    ConstantNoise,
    LearnedNoise,
    NoiseModel,
    ProcessNoise,
)
from hybrid_ins.core.update.gate import Gate
from hybrid_ins.errors import InputError
from hybrid_ins.evaluation.statistics import nees
from hybrid_ins.noise_regressor.reader import NoiseReader
from tools.paper.runs import T0_NS, Array, Run, Scenario, draw
from tools.parallel import run_parallel

LOST = 1e5  # m: a filter that far off has diverged
PAPER_WALK = np.full(6, 1e-3)  # the paper's epsilon, as a density


@dataclass(frozen=True)
class Method:
    """
    A way to set the process noise.

    Attributes
    ----------
    name : str
        For tables.
    kind : str
        constant, innovation, literal (eq. 18 of [1]_ at every IMU step), learned, scaled (learned,
        times factors from the innovations: the node's default), or oracle, which is told the true
        levels at every instant.
    q : (float, float)
        Per-sample variances of accelerometer and gyroscope: the constant, the first levels, the
        fallback.
    window : int
        Innovations averaged.
    model : str
        Regressor, as parameter ``noise.model``.
    refresh : float
        Time between two estimates [s].
    smoothing : float
        Share of the last levels that is kept at an estimate, of their logarithms.
    as_printed : bool
        Qc = q and bias random walks of ``PAPER_WALK``, as the paper's text has it.
    covariance_interval : float
        Time between two steps of the covariance [s]; 0: at every sample.
    """

    name: str
    kind: Literal["constant", "innovation", "literal", "learned", "scaled", "oracle"]
    q: tuple[float, float] = (4e-4, 4e-6)
    window: int = 3
    model: str = "plateau"
    refresh: float = 0.2
    smoothing: float = 0.0
    as_printed: bool = False
    covariance_interval: float = FilterSettings().covariance_interval


@dataclass(frozen=True)
class Flight:
    """
    How a method did on a run: at its K scored epochs, and at the M fixes that were decided.

    Attributes
    ----------
    t : ndarray, shape (K,)
        [s].
    position_error : ndarray, shape (K, 3)
        [m, NED]; NaN from where a filter diverged.
    nees : ndarray, shape (K,)
        Of the whole state: 15 on average for a right covariance.
    position_nees : ndarray, shape (K,)
        Of the position alone: 3.
    q : ndarray, shape (K, 6)
        Levels in force.
    fallback : ndarray of bool, shape (K,)
        They were those of the fallback.
    fix_t : ndarray, shape (M,)
        Time of the fixes [s].
    nis : ndarray, shape (M,)
        Their normalised innovation squared: 3 on average for a right covariance.
    accepted : ndarray of bool, shape (M,)
        The gate let them pass.
    """

    t: Array
    position_error: Array
    nees: Array
    position_nees: Array
    q: Array
    fallback: NDArray[np.bool_]
    fix_t: Array
    nis: Array
    accepted: NDArray[np.bool_]

    @property
    def diverged(self) -> bool:
        """The filter went beyond ``LOST``."""
        return bool(np.isnan(self.position_error).any())

    @property
    def prmse(self) -> float:
        """Position error [m], eq. (25) of [1]_; infinite for a filter that diverged."""
        value = float(np.sqrt(np.mean(np.sum(self.position_error**2, axis=1))))
        return np.inf if self.diverged else value

    @property
    def pmae(self) -> float:
        """Position error [m], eq. (26) of [1]_; infinite for a filter that diverged."""
        value = float(np.mean(np.sum(np.abs(self.position_error), axis=1)))
        return np.inf if self.diverged else value


def fly(run: Run, method: Method, gate: Gate | None = None) -> Flight:
    """
    Run the filter over a run under a method.

    Parameters
    ----------
    run, method
        What is flown, and how the process noise is set.
    gate : Gate, optional
        One of its own for each call; without, every fix is taken.

    Raises
    ------
    InputError
        The regressor cannot be loaded.
    """
    samples, stamps = run.samples, run.samples["t_ns"]
    ring = ImuRing()
    ring.extend(samples[:1])
    first = np.concatenate((samples["f"][0], samples["w"][0]))
    # Delays do not occur here, and a short horizon keeps few rewind points.
    settings = FilterSettings(method.covariance_interval, max_delay=0.2)
    ins = InsFilter(
        run.start,
        int(stamps[0]),
        first,
        noise_of(method, run),
        gate or Gate(dict.fromkeys((1, 2, 3), np.inf), patience=0.0),
        ring,
        settings,
    )

    count = len(run.scored)
    states: list[NavState] = []  # at the scored epochs, in their order
    error, q = np.full((count, N_ERROR), np.nan), np.full((count, 6), np.nan)
    P, fallback = np.full((count, N_ERROR, N_ERROR), np.nan), np.zeros(count, bool)
    at = 0
    with np.errstate(all="ignore"):  # a filter that diverges overflows
        for t_ns, _, act in sorted(_events(run, method, ins), key=lambda event: event[:2]):
            stop = int(np.searchsorted(stamps, t_ns, side="right"))
            if stop > at + 1:
                ring.extend(samples[at + 1 : stop])
                ins.predict_block(samples[at + 1 : stop])
                at = stop - 1
            if isinstance(act, int):
                state = ins.state
                if not np.linalg.norm(_displacement(run.lla[act], state)) < LOST:
                    break
                states.append(state)
                P[act], q[act] = state.P, ins.noise.levels()
                fallback[act] = _on_fallback(ins)
            else:
                act()
        if states:
            error[: len(states)] = state_errors(run, states)
    return Flight(
        run.t,
        error[:, DP],
        nees(error, P),
        nees(error[:, DP], P[:, DP, DP]),
        q,
        fallback,
        np.array([(v.measurement.t_ns - T0_NS) * 1e-9 for v in ins.verdicts]),
        np.array([v.nis for v in ins.verdicts]),
        np.array([v.accepted for v in ins.verdicts]),
    )


def _events(
    run: Run, method: Method, ins: InsFilter
) -> Iterator[tuple[int, int, int | Callable[[], None]]]:
    """Yield stamp [ns], rank within it, and what is done then: a call, or an epoch to score."""
    stamps = run.samples["t_ns"]
    if method.kind == "oracle":
        for k in np.flatnonzero(np.diff(run.q[:, 0])).tolist():
            change = NoiseChange(
                int(stamps[k + 1]),
                FilterNoise(ConstantNoise(run.q[k + 1]), process_of(method, run)),
            )
            yield change.t_ns, 0, partial(ins.submit, change)
    if method.kind in ("learned", "scaled"):
        reader = NoiseReader(
            {**parameters.defaults(), "noise.model": method.model}, np.eye(3), _refuse
        )
        refresh = partial(_refresh, ins, reader, method.smoothing)
        for then in range(int(stamps[0]), int(stamps[-1]), int(method.refresh * 1e9)):
            yield then, 0, refresh
    for fix in run.fixes:
        yield fix.t_ns, 1, partial(ins.submit, fix)
    for k, index in enumerate(run.scored.tolist()):
        yield int(stamps[index]), 2, k


def _refresh(ins: InsFilter, reader: NoiseReader, smoothing: float) -> None:
    """Give the filter the levels of its youngest samples."""
    estimate = reader.read(ins.ring, ins.t_ns)
    if smoothing > 0.0 and estimate.q is not None and not _on_fallback(ins):
        kept = ins.noise.levels() ** smoothing
        estimate = replace(estimate, q=kept * estimate.q ** (1.0 - smoothing))
    ins.submit(estimate)


def _on_fallback(ins: InsFilter) -> bool:
    return isinstance(ins.noise.model, LearnedNoise) and ins.noise.model.on_fallback


def process_of(method: Method, run: Run) -> ProcessNoise:
    """Return the way from variances to Qc that a method uses."""
    period = float(np.median(np.diff(run.samples["t_ns"]))) * 1e-9
    walk = PAPER_WALK if method.as_printed else run.bias_walk
    return ProcessNoise(walk, period, not method.as_printed)


def noise_of(method: Method, run: Run) -> FilterNoise:
    """Return the noise that a filter assumes under a method."""
    process = process_of(method, run)
    factors = NoiseMultipleModelBank() if method.kind == "scaled" else None
    return FilterNoise(_noise_model(method, run, process), process, factors)


def _noise_model(method: Method, run: Run, process: ProcessNoise) -> NoiseModel:
    q = np.repeat(method.q, 3)
    if method.kind == "oracle":
        return ConstantNoise(run.q[0])
    if method.kind in ("learned", "scaled"):
        return LearnedNoise(q)
    if method.kind in ("innovation", "literal"):
        floor = np.repeat(
            [
                parameters.defaults()[f"noise.q_{sensor}_min"]
                for sensor in ("accelerometer", "gyroscope")
            ],
            3,
        )
        return InnovationNoise(q, floor, method.window, process, literal=method.kind == "literal")
    return ConstantNoise(q)


def _refuse(level: str, text: str) -> None:
    """Let no other regressor stand in for the one that is judged."""
    raise InputError(text)


def state_errors(run: Run, states: Sequence[NavState]) -> Array:
    """
    Return the error states, true minus estimated, shape (K, 15), at the first K scored epochs.

    Position and velocity as P has them, before the misalignment bent them, see `core.kalman`.
    """
    so_far = slice(len(states))
    estimated = np.array([state.quat_xyzw for state in states])
    turn = rotvec_from_quat(quat_multiply(run.quat_xyzw[so_far], quat_conjugate(estimated)))
    moved = [_displacement(lla, state) for lla, state in zip(run.lla, states, strict=False)]
    faster = run.velocity_n[so_far] - [state.velocity_n for state in states]
    straight = np.linalg.solve(left_jacobian(turn), np.stack((moved, faster), axis=-1))
    biases = [np.concatenate((state.bias_a, state.bias_g)) for state in states]
    return np.hstack((straight[..., 0], straight[..., 1], -turn, run.biases[so_far] - biases))


def _displacement(lla: Array, state: NavState) -> Array:
    """Return the true position less the estimated one [m], NED."""
    return np.asarray((lla - state.lla) * curvature_scale(lla))


def fly_all(
    scenario: Scenario, methods: Sequence[Method], seeds: Sequence[int], jobs: int = 1
) -> Iterator[tuple[int, list[Flight]]]:
    """
    Fly every method on the run of every seed; yields (seed, flights) in their order.

    Parameters
    ----------
    scenario, methods, seeds
        What to fly.
    jobs : int
        Processes to use; 1 stays in this one.
    """
    flown = run_parallel(_fly_one, [(scenario, methods, seed) for seed in seeds], jobs)
    yield from zip(seeds, flown, strict=True)


def _fly_one(scenario: Scenario, methods: Sequence[Method], seed: int) -> list[Flight]:
    run = draw(scenario, seed)
    return [fly(run, method) for method in methods]


CONSTANTS = tuple(Method(name.upper(), "constant", q) for name, q in PAPER_CONSTANTS.items())
