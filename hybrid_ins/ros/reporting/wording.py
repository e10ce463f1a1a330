"""
Words for the user: faults of the IMU, restarts, what alignment waits for.

Each says what happened, the value, and the remedy.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.alignment.alignment import Need, Waiting
from hybrid_ins.core.alignment.clock_search import ClockSearch
from hybrid_ins.core.alignment.multiple_model import MultipleModelBank
from hybrid_ins.core.fix_checks.frozen_height import FrozenHeight
from hybrid_ins.core.fix_checks.velocity_check import Contradiction
from hybrid_ins.core.imu.health import FaultKind, ImuFault
from hybrid_ins.core.navigator.navigator import Navigator
from hybrid_ins.core.navigator.notices import (
    GapBridged,
    HeadingCorrected,
    HeadingOutdated,
    RestartCause,
    Restarted,
)
from hybrid_ins.core.navigator.phases import Aligning, Searching
from hybrid_ins.core.navigator.stamp_check import StampFault
from hybrid_ins.core.update.gate import Verdict
from hybrid_ins.ros.messages.conversions import FLIP, Refused

Array = NDArray[np.float64]

ONE_G = (0.7, 1.3)  # mean specific force of an IMU at rest that reports in g

STAMP_FAULTS = {
    StampFault.REPEATED: Refused(
        "imu: repeated stamp",
        "header.stamp repeats: the driver stamps twice, or two publishers share the topic",
    ),
    StampFault.OUT_OF_ORDER: Refused(
        "imu: stamp out of order",
        "header.stamp goes back a little: the driver stamps on receipt, or two publishers share "
        "the topic",
    ),
    StampFault.JUMP: Refused(
        "imu: stamp jumps",
        "header.stamp jumps; the samples are used once the stamps stay there",
    ),
}
DIRECTIONS = ("forward", "backward"), ("left", "right"), ("up", "down")
STATES = {"imu": "waiting for the IMU", "gnss": "waiting for GNSS", "heading": "finding heading"}


def place_of(error_b: Array, std: Array, digits: int) -> str:
    """Return a displacement and its σ, (3,) [m], b, by the directions it goes in."""
    return ", ".join(
        f"{abs(value):.{digits}f} ± {sigma:.{digits}f} m {names[int(value < 0.0)]}"
        for names, value, sigma in zip(
            DIRECTIONS, (FLIP @ error_b).tolist(), std.tolist(), strict=True
        )
    )


def name_of_fault(fault: ImuFault) -> str:
    """Return the name under which a fault is counted."""
    return f"imu: {fault.kind.value}"


def describe_fault(fault: ImuFault) -> str:
    """Return what a fault is, the value that shows it, and the remedy."""
    kind, value = fault.kind, fault.value
    if kind is FaultKind.NO_GRAVITY:
        remedy = (
            "the unit seems to be g: multiply by 9.80665"
            if ONE_G[0] < value < ONE_G[1]
            else "gravity seems to be removed: let the driver publish specific force"
        )
        return f"mean acceleration is {value:.2f} m/s², not 9.8: {remedy}"
    if kind is FaultKind.TOO_MUCH_GRAVITY:
        return f"mean acceleration is {value:.1f} m/s², not 9.8: check the unit (m/s² is expected)"
    if kind is FaultKind.FROZEN:
        return (
            "the same reading again and again while it shows a turn: restart the driver, check "
            "the cable"
        )
    if kind is FaultKind.DEGREES:
        return (
            f"rates of {value:.0f} do not fit the acceleration: they seem to be in degrees per "
            "second; radians per second are expected"
        )
    is_force = kind in (FaultKind.SATURATED_FORCE, FaultKind.SPIKES_FORCE)
    name, unit = ("acceleration", "m/s²") if is_force else ("rate", "rad/s")
    if kind in (FaultKind.SATURATED_FORCE, FaultKind.SATURATED_RATE):
        return (
            f"{name} on axis {'xyz'[fault.axis]} stays at {value:.2f} {unit}: choose a larger "
            "range, or dampen the mount"
        )
    return (
        f"single readings of {name} jump by {value:.1f} {unit} and back: check plugs, cables, "
        "shielding"
    )


def describe_gap(bridged: GapBridged) -> str:
    """Return for how long nothing was measured, and what became of that."""
    return f"no samples for {bridged.seconds:.1f} s: the filter went on, less certain"


def describe_restart(restarted: Restarted) -> str:
    """Return why a state was given up."""
    cause = restarted.cause
    if cause is RestartCause.STAMPS_WENT_BACK:
        return f"the IMU's stamps went back by {restarted.seconds:.1f} s"
    if cause is RestartCause.NO_SAMPLES:
        return f"no IMU samples for {restarted.seconds:.1f} s"
    if cause is RestartCause.NOT_FINITE:
        return "the filter's state became NaN or infinite"
    if cause is RestartCause.IMU_UNUSABLE and restarted.fault is not None:
        return f"the IMU is unusable: {describe_fault(restarted.fault)}"
    if cause is RestartCause.TURN_UNMEASURED and restarted.fault is not None:
        lost = math.degrees(restarted.fault.lost_turn)
        return f"a turn beyond the gyroscope's range: up to {min(lost, 360.0):.0f}° are missing"
    if cause is RestartCause.FIXES_JUMPED:
        return "the fixes jumped before the heading was known, and fit none"
    if cause is RestartCause.FIXES_REPEATED:
        return "repeated fixes were taken for new ones before the heading was known"
    if cause is RestartCause.FIXES_WANDERED:
        return "the wander of the fixes was taken for motion while the vehicle stood"
    if cause is RestartCause.VELOCITIES_WRONG:
        return "the state rests on velocities that contradict the positions"
    return "repeated covariance resets: the heading is probably wrong"


TURNS_ON_THE_SPOT = (
    "the vehicle only turns on the spot, and nobody has said where the antenna is: the fixes may "
    "show the motion of the antenna about the vehicle, which tells no heading: travel, or set "
    "gnss.antenna_position"
)


def describe_contradiction(found: Contradiction) -> str:
    """Return how velocities contradict the positions, and the remedy."""
    moved, summed = _in_words(found.moved_n), _in_words(found.summed_n)
    return (
        f"in {found.seconds:.0f} s the positions moved by {moved} and the velocities add up to "
        f"{summed}: let the driver publish m/s along east, north, up (not north first, nor along "
        "the vehicle)"
    )


def describe_frozen_height(found: FrozenHeight) -> str:
    """Return what was measured as the height all the time, and the remedy."""
    return (
        f"altitude stays at {found.height:.8g} m, to the last digit, in {found.count} fixes and "
        f"over {found.way:.0f} m: it is not used until it changes, and the height is unknown; let "
        "the driver fill it, or leave it NaN"
    )


def _in_words(way_n: Array) -> str:
    """Return a way (3,) [m], NED, in words."""
    north, east, down = way_n.tolist()
    words = f"{east:+.0f} m east, {north:+.0f} m north"
    return words if math.isnan(down) else f"{words}, {-down:+.0f} m up"


def describe_repetition(again: Verdict, count: int) -> str:
    """Return that a driver repeats what it has published, and the remedy."""
    kind = again.measurement.kind
    return (
        f"gnss: the driver publishes some {kind}s several times, with new stamps ({count} repeated "
        "so far): only the first of each is used; let the driver publish at the receiver's rate"
    )


def state_of(navigator: Navigator) -> str:
    """Return where a navigator is, as diagnostics call it."""
    phase = navigator.phase
    if isinstance(phase, Aligning):
        return STATES[phase.alignment.waiting.stage]
    return STATES["heading"] if isinstance(phase, Searching) else "aligned"


def waiting_for(navigator: Navigator) -> str:
    """Return what alignment lacks; empty once one filter runs."""
    phase = navigator.phase
    if isinstance(phase, Aligning):
        return _describe_need(phase.alignment.waiting)
    return _describe_search(phase.bank) if isinstance(phase, Searching) else ""


def _describe_need(waiting: Waiting) -> str:
    need = waiting.need
    if need is Need.WINDOW:
        return f"{waiting.limit:g} s of IMU samples for levelling"
    if need is Need.USABLE_IMU and waiting.fault is not None:
        return f"usable IMU samples: {describe_fault(waiting.fault)}"
    if need is Need.SECOND_FIX:
        return "a second GNSS fix, for the first velocity"
    if need is Need.ORIENTATION:
        return (
            "an orientation in the IMU messages: let the driver fill it, or choose another "
            "alignment.heading_source than imu"
        )
    if need is Need.SPEED:
        return (
            f"motion for the heading: {waiting.value:.1f} m/s over ground, {waiting.limit:g} needed"
        )
    return str(need.value)


def _describe_search(bank: MultipleModelBank) -> str:
    clock = ""
    if isinstance(bank, ClockSearch):
        clock = f" and the clock offset (to {bank.clock()[1]:.2f} s)"
    return (
        f"motion that shows the heading (known to {math.degrees(bank.heading()[1]):.0f}° "
        f"so far){clock}: speed up, brake or turn, or give it by initialpose"
    )


def describe_heading(yaw: float, std: float) -> str:
    """Return a heading and its standard deviation [rad], clockwise from north."""
    heading, sigma = round(math.degrees(yaw), 1) % 360.0, math.degrees(std)
    return f"heading {heading:.1f}° ± {sigma:.1f}° from north"


def describe_correction(found: HeadingCorrected) -> str:
    """Return what the motion has shown of the heading, and what to check."""
    before, after = (round(math.degrees(yaw)) % 360 for yaw in (found.before, found.after))
    return (
        f"the motion shows a heading of {after}° ± {math.degrees(found.sigma):.0f}° from "
        f"north, not {before}°: corrected; check alignment.yaw, /initialpose or the IMU's "
        "orientation, whichever gave it, and imu.mount_rpy"
    )


def describe_outdated_heading(notice: HeadingOutdated) -> str:
    """Return why a given heading is not used, and what to do about it."""
    return (
        f"the heading that was given is known to {math.degrees(notice.std):.0f}° only by now: the "
        "vehicle has moved for too long before the first fixes; the motion decides instead (give "
        "the heading again on /initialpose once fixes arrive, or imu.gyroscope_bias with its "
        "small std)"
    )
