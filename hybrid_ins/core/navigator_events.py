"""
What happens to a navigator, as records in one queue: `Navigator.pop_events`.

Verdicts on measurements (`hybrid_ins.core.gate.Verdict`) are in the same queue, in order.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from hybrid_ins.core.gate import Verdict
from hybrid_ins.core.imu_health import ImuFault


class RestartCause(Enum):
    """Why a state was given up; the value is the name under which it is counted."""

    STAMPS_WENT_BACK = "the IMU's stamps went back"
    NO_SAMPLES = "no IMU samples"
    IMU_UNUSABLE = "the IMU is unusable"
    NOT_FINITE = "the state was lost"
    REPEATED_RESETS = "the state did not fit the fixes"


@dataclass(frozen=True, slots=True)
class GapBridged:
    """IMU samples were missing for so long [s], and the filter went on."""

    seconds: float


@dataclass(frozen=True, slots=True)
class Restarted:
    """The state was given up, and alignment restarted."""

    cause: RestartCause
    seconds: float = 0.0  # by which the stamps went back or were missing
    fault: ImuFault | None = None  # of an IMU that is unusable


@dataclass(frozen=True, slots=True)
class FaultFound:
    """The IMU began to show a fault, or shows another one."""

    fault: ImuFault


@dataclass(frozen=True, slots=True)
class ClockOffsetFound:
    """
    A search has found the clock offset of the fixes.

    Measurements from now on are to be stamped by ``step`` more than before.
    """

    step: float  # s, to be added to the offset in force
    missing: float  # s, that the filter still finds missing after that
    sigma: float  # s


Event = Verdict | GapBridged | Restarted | FaultFound | ClockOffsetFound
