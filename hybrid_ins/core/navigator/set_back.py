"""
The IMU's clock is set back by less than makes a new time base.

Samples are refused until their stamps have caught up, and the next one follows the last that was
used as if no time had passed. The vehicle has moved on meanwhile.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.filter.events import Change, ClockInflation, CovarianceInflation
from hybrid_ins.core.filter.gap import GAP_FORCE, GAP_RATE
from hybrid_ins.core.imu.samples import ImuRing, readings_of, sample_period
from hybrid_ins.core.inertial.earth import STANDARD_GRAVITY
from hybrid_ins.core.inertial.rotations import matrix_from_quat
from hybrid_ins.core.inertial.state import DP, DV, EPS, LAST_F, LAST_W, N_ERROR, QUAT, VELOCITY
from hybrid_ins.core.navigator.notices import GapBridged
from hybrid_ins.core.navigator.phase_machine import PhaseMachine
from hybrid_ins.core.navigator.stamp_check import JUMP_CONFIRMED

Array = NDArray[np.float64]

PERIOD_SAMPLES = 64  # that show the IMU's period
STEADY = 0.5, 2.0  # times the IMU's period, that theirs is


class SetBackWatch:
    """
    Finds from refused samples for how long the vehicle moved while the stamps caught up.

    Samples of a clock that was set back have the IMU's period, and their stamps end where those in
    use do: the next one goes on. Those of a block that others have overtaken end before it; a block
    that is sent again has stamps and readings that are known; behind a stray stamp that was ahead
    the time is in the step that led there.

    Parameters
    ----------
    ring : ImuRing
        The samples that were used; its owner fills it.
    phases : PhaseMachine
        Its filters become as uncertain as they are.
    on_found : callable
        Called with the time that has no stamps.
    """

    def __init__(
        self, ring: ImuRing, phases: PhaseMachine, on_found: Callable[[GapBridged], None]
    ) -> None:
        self._ring, self._phases, self._on_found = ring, phases, on_found
        self._used = 0  # samples, when the run began
        self._first_ns = self._last_ns = self._count = 0  # stamps and number of the run's

    def observe(self, t_ns: int, reading: Sequence[float]) -> None:
        """Use a sample that was refused: stamp [ns], specific force and angular rate (6,), b."""
        seconds, best = self._time_without_stamps(t_ns, reading), self._phases.phase.best
        if seconds:
            self._on_found(GapBridged(seconds))
        if seconds and best is not None:
            for event in left_behind(best.nav, int(self._ring.latest(1)["t_ns"][0]), seconds):
                self._phases.submit(event)

    def _time_without_stamps(self, t_ns: int, reading: Sequence[float]) -> float:
        """Return how long it took the stamps to catch up [s], once they do; else 0."""
        ring = self._ring
        known = readings_of(ring.between(t_ns - 1, t_ns))
        if len(known) and np.array_equal(known[-1], reading):
            self._count = 0
            return 0.0
        if not self._count or ring.count != self._used or t_ns <= self._last_ns:
            self._used, self._first_ns, self._count = ring.count, t_ns, 0
        self._count, self._last_ns = self._count + 1, t_ns
        if self._count < JUMP_CONFIRMED:
            return 0.0
        used_ns = ring.latest(PERIOD_SAMPLES)["t_ns"]
        period_ns = (t_ns - self._first_ns) / (self._count - 1)
        usual_ns = 1e9 * sample_period(used_ns) if len(used_ns) > 1 else 0.0
        has_caught_up = t_ns + 1.5 * period_ns > used_ns[-1]  # the next one may be early
        if not has_caught_up or not STEADY[0] * usual_ns < period_ns < STEADY[1] * usual_ns:
            return 0.0
        lost_ns = int(used_ns[-2]) - self._first_ns + 2.0 * period_ns
        is_stray = lost_ns < 0.5 * self._count * period_ns
        self._count = 0
        return 0.0 if is_stray else lost_ns * 1e-9


def left_behind(nav: Array, t_ns: int, seconds: float) -> tuple[Change, ...]:
    """
    Return how uncertain a filter is whose vehicle has moved on for some time without stamps.

    Which clocks were set is not known: the offset of the fixes may have changed as much.

    Parameters
    ----------
    nav : ndarray, shape (N_FLAT,)
        Flat state at ``t_ns``, the last stamp that was used [ns].
    seconds : float
        That time.
    """
    acceleration_n = matrix_from_quat(nav[QUAT]) @ nav[LAST_F] + [0.0, 0.0, STANDARD_GRAVITY]
    acceleration = GAP_FORCE + float(np.linalg.norm(acceleration_n))
    std = np.zeros(N_ERROR)
    std[DP] = seconds * (float(np.linalg.norm(nav[VELOCITY])) + 0.5 * seconds * acceleration)
    std[DV] = seconds * acceleration
    std[EPS] = seconds * (GAP_RATE + float(np.linalg.norm(nav[LAST_W])))
    return CovarianceInflation(t_ns, std, np.zeros(3)), ClockInflation(t_ns, seconds)
