"""Simulated runs fed to a navigator, for the tests of alignment, gaps and recovery."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from hybrid_ins.core.alignment.alignment import AlignmentSettings
from hybrid_ins.core.filter.filter_noise import FilterNoise
from hybrid_ins.core.filter.filter_settings import FilterSettings
from hybrid_ins.core.fix_checks.fix_speed import SpeedCheck
from hybrid_ins.core.inertial.earth import curvature_scale
from hybrid_ins.core.inertial.rotations import heading_from_quat, rpy_from_quat
from hybrid_ins.core.inertial.state import COVARIANCE, DIAGONAL, LLA, QUAT, VELOCITY
from hybrid_ins.core.navigator.navigator import Navigator
from hybrid_ins.core.navigator.notices import Notice
from hybrid_ins.core.noise.process_noise import ConstantNoise, ProcessNoise
from hybrid_ins.core.update.chi_square import quantile
from hybrid_ins.core.update.gate import Gate, Verdict
from hybrid_ins.core.update.measurements import PositionFix
from hybrid_ins.simulation.motions import Motion
from hybrid_ins.simulation.sensors import (
    RTK_STD,
    ImuErrors,
    Truth,
    corrupt,
    fixes,
    sample,
    sample_times,
)

EPOCH_NS = 1_000_000_000_000
Q = np.repeat([4e-4, 4e-6], 3)


class Parts:
    """Filter parts with constant noise, see `hybrid_ins.core.navigator.phases.FilterParts`."""

    def __init__(self, lever_b: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        self.settings = FilterSettings(lever_b=np.asarray(lever_b))
        self.mount = np.eye(3)
        self.speed_check = SpeedCheck(515.0, 3.0)

    def noise(self, period: float) -> FilterNoise:
        return FilterNoise(ConstantNoise(Q), ProcessNoise(np.repeat([1e-6, 1e-8], 3), period), None)

    def gate(self) -> Gate:
        return Gate({m: quantile(0.9999, m) for m in (1, 2, 3, 6)}, 3.0)


def make_navigator(
    source: str = "auto",
    *,
    yaw: float = 0.0,
    yaw_std: float = 0.05,
    max_gap: float = 2.0,
    bias_a: ArrayLike = (0.0, 0.0, 0.0),
    bias_g: ArrayLike = (0.0, 0.0, 0.0),
    lever_b: ArrayLike = (0.0, 0.0, 0.0),
    parts: Parts | None = None,
) -> Navigator:
    settings = AlignmentSettings(
        source,
        yaw,
        yaw_std,
        1.0,
        1.0,
        np.array(bias_a),
        np.full(3, 0.3),
        np.array(bias_g),
        np.full(3, 0.01),
    )
    return Navigator(settings, parts or Parts(lever_b), max_gap)


@dataclass
class Scene:
    """A run with imperfect sensors: rows of (t, force, rate), fixes, and the truth."""

    truth: Truth
    t: np.ndarray
    force: np.ndarray
    rate: np.ndarray
    fix_t: np.ndarray
    fix_lla: np.ndarray
    covariance: np.ndarray
    verdicts: list[Verdict] = field(default_factory=list)
    notices: list[Notice] = field(default_factory=list)  # all others

    def yaw(self, t: float) -> float:
        k = int(np.argmin(np.abs(self.truth.t - t)))
        return float(rpy_from_quat(self.truth.quat_xyzw[k])[2])

    def errors(self, navigator: Navigator, t: float) -> tuple[float, float, float]:
        """Horizontal position [m], velocity [m/s] and heading [rad] error at a time."""
        running = navigator.phase.best
        assert running is not None
        k = int(np.argmin(np.abs(self.truth.t - t)))
        metres = (running.nav[LLA] - self.truth.lla[k]) * curvature_scale(self.truth.lla[k])
        velocity = running.nav[VELOCITY] - self.truth.velocity_n[k]
        yaw = heading_from_quat(running.nav[QUAT]) - self.yaw(t)
        return (
            float(np.hypot(*metres[:2])),
            float(np.linalg.norm(velocity)),
            abs(float(np.angle(np.exp(1j * yaw)))),
        )


def scene(
    trajectory: Motion,
    *,
    rate: float = 100.0,
    fix_rate: float = 5.0,
    fix_times: ArrayLike | None = None,
    seed: int = 0,
    errors: ImuErrors | None = None,
    lever_arm_b: ArrayLike = (0.0, 0.0, 0.0),
    fix_std: ArrayLike = RTK_STD,
) -> Scene:
    """Simulate what the IMU and the receiver report on a trajectory; the same for each seed."""
    rng = np.random.default_rng(seed)
    truth = sample(trajectory, sample_times(trajectory.duration, rate))
    imu = corrupt(truth, errors or ImuErrors(), rng)
    if fix_times is None:
        fix_times = sample_times(trajectory.duration, fix_rate)
    gnss = fixes(sample(trajectory, fix_times), rng, fix_std, lever_arm_b=lever_arm_b)
    return Scene(
        truth,
        imu.t,
        imu.specific_force,
        imu.angular_rate,
        gnss.t,
        gnss.lla,
        np.diag(gnss.position_std**2),
    )


def play(
    run: Scene,
    navigator: Navigator,
    start: float = 0.0,
    stop: float = np.inf,
    *,
    delay: Callable[[float], float] = lambda t: 0.0,
    imu: Callable[[float], bool] = lambda t: True,
    fix: Callable[[float], bool] = lambda t: True,
    shift: Callable[[float], float] = lambda t: 0.0,
    after: Callable[[float], None] = lambda t: None,
    lever_b: ArrayLike = (0.0, 0.0, 0.0),
) -> None:
    """
    Feed a stretch of a run to a navigator.

    ``delay`` is how late a fix arrives [s], ``imu`` and ``fix`` tell which are not lost, ``shift``
    is how far north a fix lies beside the truth [m], ``after`` is called after each sample. The
    receiver's antenna is said to be at ``lever_b``, relative to the IMU [m].
    """
    pending = sorted(
        (t + delay(t), t, k) for k, t in enumerate(run.fix_t) if start <= t < stop and fix(t)
    )
    for k in np.flatnonzero((run.t >= start) & (run.t < stop)):
        t = float(run.t[k])
        if imu(t):
            navigator.imu(stamp(t), *run.force[k], *run.rate[k])
        while pending and pending[0][0] <= t:
            _, true_t, j = pending.pop(0)
            lla = run.fix_lla[j] + [shift(true_t) / curvature_scale(run.truth.lla[0])[0], 0, 0]
            navigator.measure(PositionFix(stamp(true_t), lla, run.covariance, np.asarray(lever_b)))
        navigator.check_imu()
        for notice in navigator.pop_notices():
            (run.verdicts if isinstance(notice, Verdict) else run.notices).append(notice)
        after(t)


def stamp(t: float) -> int:
    return EPOCH_NS + round(t * 1e9)


def heading_std(navigator: Navigator) -> float:
    """What the navigator says of its heading [rad]."""
    if navigator.phase.bank is not None:
        return navigator.phase.bank.heading()[1]
    assert navigator.filter is not None
    return float(np.sqrt(navigator.filter.nav[COVARIANCE][DIAGONAL][8]))
