"""
Health of the IMU and standing of the vehicle, checked twice a second while a filter runs.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.gate import Verdict
from hybrid_ins.core.imu_health import FaultKind, ImuFault, find_fault
from hybrid_ins.core.ins_filter import InsFilter
from hybrid_ins.core.samples import ImuRing
from hybrid_ins.core.standstill import is_standing
from hybrid_ins.core.state import B_A, B_G, DV, EPS, N_ERROR, VELOCITY, covariance

Array = NDArray[np.float64]

PERIOD_NS = 500_000_000  # between two checks
WINDOW_NS = 1_000_000_000  # of samples that are checked
SHORTEST_STAND = 0.8e9  # ns, of samples that may show standing
SPEED_NIS_STANDING = 7.8  # chi-square, 3 degrees of freedom, 95 %
LONGEST_FALL_NS = 5_000_000_000  # without weight
LAST_FIX_NS = 1_100_000_000  # age of the last fix that confirms a fall
UNKNOWN_BIAS_STD_A, UNKNOWN_BIAS_STD_G = 0.3, 0.01  # m/s², rad/s: after misleading readings
MISLED_SPEED, MISLED_TURN = 1.5, 0.1  # m/s, rad: between two checks of such readings
MISLEADING_FORCE = (FaultKind.SATURATED_FORCE, FaultKind.SPIKES_FORCE)
MISLEADING_RATE = (FaultKind.SATURATED_RATE, FaultKind.SPIKES_RATE)


class ImuMonitor:
    """
    Checks the last second of samples for faults and for standing.

    Attributes
    ----------
    fault : ImuFault or None
        What the last check found.
    falling : bool
        The vehicle fell freely at the last check.
    standing : bool
        The vehicle stood at the last check.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Restart, as the filter did."""
        self.fault: ImuFault | None = None
        self.falling = self.standing = False
        self._next_ns = 0
        self._fix_agreed_ns = 0  # stamp of the last fix, if it was fused without a reset
        self._weighed_ns = 0  # last check that found gravity

    def is_due(self, t_ns: int) -> bool:
        """Return whether to check at a stamp [ns]."""
        return t_ns >= self._next_ns

    def on_verdict(self, verdict: Verdict) -> None:
        """Note whether the last fix agreed with the filter."""
        if verdict.measurement.kind == "position":
            agreed = verdict.accepted and not verdict.inflated
            self._fix_agreed_ns = verdict.measurement.t_ns if agreed else 0

    def check_fault(self, ring: ImuRing, t_ns: int, running: bool) -> list[ImuFault]:
        """
        Set ``fault`` and ``falling`` by the samples up to a stamp [ns].

        ``running`` tells whether there is one filter whose fixes can confirm a fall. Returns the
        faults of the previous and of this check: what happened between them misled the filter.
        """
        self._next_ns = t_ns + PERIOD_NS
        self._samples = ring.after(t_ns - WINDOW_NS)
        before, self.fault = self.fault, find_fault(self._samples)
        self.falling = self._is_falling(t_ns, running)
        if self.falling:
            self.fault = None
        return [fault for fault in (before, self.fault) if fault is not None]

    def check_standing(
        self, t_ns: int, running: InsFilter, fixes_move: bool
    ) -> NDArray[np.void] | None:
        """Set ``standing``, unless the fixes move; return the samples of a vehicle that stands."""
        samples = self._samples
        span = t_ns - samples["t_ns"][0]
        self.standing = (
            span > SHORTEST_STAND
            and not fixes_move
            and is_standing(samples)
            and _zero_speed_is_plausible(running)
        )
        return samples if self.standing else None

    def _is_falling(self, t_ns: int, running: bool) -> bool:
        """
        Distinguish a free fall from an IMU without gravity.

        To the filter both are a fall. Where the vehicle does not fall, the next fix is beyond the
        gate.
        """
        if self.fault is None or self.fault.kind is not FaultKind.NO_GRAVITY:
            self._weighed_ns = t_ns
            return False
        return (
            running
            and t_ns - self._weighed_ns < LONGEST_FALL_NS
            and t_ns - self._fix_agreed_ns < LAST_FIX_NS
        )


def error_std_after(fault: ImuFault) -> Array | None:
    """
    Return what readings with a fault may have done to the state between two checks.

    Standard deviations, shape (15,), in the order of the error state; None where the fault does
    not mislead.
    """
    std = np.zeros(N_ERROR)
    if fault.kind in MISLEADING_FORCE:
        std[B_A], std[DV] = UNKNOWN_BIAS_STD_A, MISLED_SPEED
    elif fault.kind in MISLEADING_RATE:
        std[B_G], std[EPS] = UNKNOWN_BIAS_STD_G, MISLED_TURN
    else:
        return None
    return std


def _zero_speed_is_plausible(running: InsFilter) -> bool:
    """Return whether the filter's speed may be zero: a smooth cruise resembles standing."""
    velocity = running.nav[VELOCITY]
    P = covariance(running.nav)[DV, DV] + 0.05**2 * np.eye(3)
    return bool(velocity @ np.linalg.solve(P, velocity) < SPEED_NIS_STANDING)
