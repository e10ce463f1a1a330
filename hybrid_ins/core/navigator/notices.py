"""
What a navigator reports of itself, as records in one queue: `Navigator.pop_notices`.

Verdicts on measurements (`hybrid_ins.core.update.gate.Verdict`) are in the same queue, in order.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from hybrid_ins.core.fix_checks.frozen_height import FrozenHeight
from hybrid_ins.core.fix_checks.velocity_check import Contradiction
from hybrid_ins.core.imu.health import ImuFault
from hybrid_ins.core.inertial.rotations import heading_from_quat
from hybrid_ins.core.inertial.state import NavState
from hybrid_ins.core.update.gate import Verdict


class RestartCause(Enum):
    """Why a state was given up; the value is the name under which it is counted."""

    STAMPS_WENT_BACK = "the IMU's stamps went back"
    NO_SAMPLES = "no IMU samples"
    IMU_UNUSABLE = "the IMU is unusable"
    TURN_UNMEASURED = "a turn beyond the gyroscope's range"
    NOT_FINITE = "the state was lost"
    REPEATED_RESETS = "the state did not fit the fixes"
    FIXES_JUMPED = "the fixes jumped before the heading was known"
    FIXES_REPEATED = "the driver repeats fixes"
    FIXES_WANDERED = "the fixes wandered while the vehicle stood"
    VELOCITIES_WRONG = "the velocities contradict the positions"


@dataclass(frozen=True, slots=True)
class GapBridged:
    """IMU samples were missing for so long [s], and the filter went on."""

    seconds: float


@dataclass(frozen=True, slots=True)
class Restarted:
    """The state was given up, and alignment restarted."""

    cause: RestartCause
    seconds: float = 0.0  # by which the stamps went back or were missing
    fault: ImuFault | None = None  # of the IMU


@dataclass(frozen=True, slots=True)
class TurnedOnTheSpot:
    """What was seen of the motion shows no heading: alignment restarted."""


@dataclass(frozen=True, slots=True)
class FaultFound:
    """The IMU began to show a fault, or shows another one."""

    fault: ImuFault


@dataclass(frozen=True, slots=True)
class ClockOffsetFound:
    """
    A search has found the clock offset of the fixes, or one to go on with.

    Measurements from now on are to be stamped by ``step`` more than before.
    """

    step: float  # s, to be added to the offset in force
    missing: float  # s, that the filter still finds missing after that
    sigma: float  # s
    is_final: bool = True  # otherwise the search goes on


@dataclass(frozen=True, slots=True)
class HeadingOutdated:
    """A given heading is not used: the vehicle has moved for too long before the first fixes."""

    std: float  # rad, of the heading by now


@dataclass(frozen=True, slots=True)
class HeadingCorrected:
    """The motion has contradicted the filter's heading, and another filter took over."""

    before: float  # rad from north
    after: float  # rad from north
    sigma: float  # rad

    @classmethod
    def between(cls, before: NavState, after: NavState) -> HeadingCorrected:
        """Return the change from one state to the other."""
        sigma = math.sqrt(after.P[8, 8])
        return cls(heading_from_quat(before.quat_xyzw), heading_from_quat(after.quat_xyzw), sigma)


Notice = (
    Verdict
    | GapBridged
    | Restarted
    | TurnedOnTheSpot
    | FaultFound
    | ClockOffsetFound
    | HeadingCorrected
    | HeadingOutdated
    | Contradiction
    | FrozenHeight
)
