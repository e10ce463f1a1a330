"""
The check of the IMU's axes and units and of the antenna's place while the estimator runs, in words.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.imu_axes.faults import SCALES, AxesFault
from hybrid_ins.core.imu_axes.level import Tilt
from hybrid_ins.core.imu_axes.monitor import ImuAxesCheck
from hybrid_ins.core.inertial.rotations import quat_from_matrix, rpy_from_quat
from hybrid_ins.core.navigator.navigator import Navigator
from hybrid_ins.core.update.measurements import Measurement, PositionFix
from hybrid_ins.ros.messages.conversions import FLIP, Refused
from hybrid_ins.ros.placement.sensor_placement import SensorPlacement
from hybrid_ins.ros.reporting.input_log import InputLog
from hybrid_ins.ros.reporting.wording import place_of

Array = NDArray[np.float64]

SAMPLES_NS = 500_000_000  # between two checks of the IMU's ring buffer
LONGEST_GAP_NS = 500_000_000  # between samples, over which nothing is integrated
MOST_EXPLANATIONS = 3  # in a text, the most ordinary first
WRONG_UNIT = "imu: wrong unit"  # the name of the fault
ACCELERATION, RATE = "linear_acceleration", "angular_velocity"


class AxesMonitor:
    """
    Gives the check what the navigator is given, and warns of what it finds.

    Parameters
    ----------
    navigator : Navigator
        Its samples are checked.
    placement : SensorPlacement
        Where the sensors are; an antenna that is far from there is moved.
    inputs : InputLog
        Warns.
    """

    def __init__(self, navigator: Navigator, placement: SensorPlacement, inputs: InputLog) -> None:
        self._navigator = navigator
        self._inputs = inputs
        self._placement = placement
        self.restart()

    def restart(self) -> None:
        """Start anew: the sensors are elsewhere."""
        self._check = ImuAxesCheck(self._placement.mount, self._placement.lever_b)
        self._taken_ns = self._next_ns = 0
        self._reported: AxesFault | None = None
        self._was_tilted = False

    @property
    def fault(self) -> Refused | None:
        """What is wrong, as a name and a text."""
        return None if self._check.fault is None else describe(self._check.fault)

    @property
    def tilt(self) -> Refused | None:
        """How the mount seems to be tilted, as a name and a text; it is only a warning."""
        return None if self._check.tilt is None else describe(self._check.tilt)

    @property
    def moved_b(self) -> Array:
        """Where the antenna is taken to be, less where it is given, (3,) [m], b."""
        return self._placement.antenna_error_b

    @property
    def are_plausible(self) -> bool:
        """Nothing seems wrong, and the axes have been compared with the motion."""
        return not self._check.doubtful

    def observe(self, measurement: Measurement) -> None:
        """Use a position fix; other measurements are ignored."""
        if isinstance(measurement, PositionFix):
            self._check.add_fix(measurement.t_ns, measurement.lla)

    def run_periodic(self) -> bool:
        """Do what is due, some times a second; return whether the antenna was moved."""
        t_ns = self._navigator.last_ns
        if t_ns < self._taken_ns:  # a new time base
            self._check.reset()
            self._taken_ns = self._next_ns = 0
        if t_ns >= self._next_ns:
            self._next_ns = t_ns + SAMPLES_NS
            self._take_samples()
        self._check.advance(t_ns)
        if self._check.fault is not self._reported:
            self._reported = self._check.fault
            if self._reported is not None:
                self._inputs.count_and_warn("imu/data", describe(self._reported))
        tilt = self.tilt
        if tilt is not None and not self._was_tilted:
            self._inputs.count_and_warn("imu/data", tilt)
        self._was_tilted = tilt is not None
        found, placement = self._check.antenna_error_b, self._placement
        if found is None:
            return False
        placement.move_antenna(*found)
        moved = describe_antenna(placement.antenna_error_b, placement.antenna_std)
        self._inputs.count_and_warn("gnss/fix", moved)
        return True

    def _take_samples(self) -> None:
        samples = self._navigator.ring.after(self._taken_ns)
        if not len(samples):
            return
        stamps = samples["t_ns"]
        gaps = np.flatnonzero(np.diff(stamps) > LONGEST_GAP_NS)
        first = int(gaps[-1]) + 1 if len(gaps) else 0
        if len(gaps) or stamps[0] - self._taken_ns > LONGEST_GAP_NS:
            self._check.reset()
        self._taken_ns = int(stamps[-1])
        self._check.add_samples(samples[first:])


def describe_antenna(error_b: Array, std: Array) -> Refused:
    """Return that the antenna is ``error_b`` ± ``std`` (3,) [m], b, from where it is given."""
    place = place_of(error_b, std, digits=2)
    return Refused(
        "gnss: antenna elsewhere",
        f"the motion shows the antenna {place} of where imu.position and gnss.antenna_position put "
        "it: correct them; until then it is taken to be there",
    )


def describe(fault: AxesFault | Tilt) -> Refused:
    """Return what is wrong with axes, units or mount, and the remedy."""
    if isinstance(fault, Tilt):
        return _describe_tilt(fault)
    one = np.eye(3)
    if fault.no_turns:
        return Refused(
            "imu: no rates",
            f"{RATE} does not change while the vehicle moves: check that the driver fills it",
        )
    _, gyroscope = fault.explanations[0]
    factor = gyroscope[0, 0]
    if np.allclose(gyroscope, SCALES[0] * one):
        return Refused(
            WRONG_UNIT,
            f"{RATE} fits the motion only if it is divided by 57.3: it is in degrees per second; "
            "let the driver publish radians per second",
        )
    if np.allclose(gyroscope, SCALES[1] * one):
        return Refused(
            WRONG_UNIT,
            f"{RATE} is {factor:.1f} times too small for the motion: multiply it by {factor:.1f} "
            "(degrees converted to radians twice?)",
        )
    if fault.turned and np.allclose(fault.explanations[0], one):
        return Refused("imu: wrong mount", _describe_mount(fault))
    ways = fault.explanations[:MOST_EXPLANATIONS]
    text = "the axes do not fit the motion: " + ", or ".join(_describe_axes(*way) for way in ways)
    if fault.turned:
        text += f"; then {_remount(fault.mount)}"
    if any(_is_mirrored(*way) for way in fault.explanations):
        text += "; or latitude and longitude of the fixes are exchanged, or a sign of them is wrong"
    return Refused("imu: wrong axes", f"{text}; correct the driver")


def _describe_tilt(tilt: Tilt) -> Refused:
    """Return how a mount is tilted, and the one that is level."""
    return Refused(
        "imu: tilted mount",
        f"in {tilt.seconds:.0f} s of motion the mean specific force is {np.degrees(tilt.angle):.0f}"
        f"° from base_frame's z axis: {_remount(tilt.mount)} (roll and pitch are measured, yaw is "
        "as given), unless the vehicle itself is as tilted",
    )


def _is_mirrored(accelerometer: Array, gyroscope: Array) -> bool:
    """
    Return whether readings need what fits them to a mirrored track, by their factors (3, 3).

    A mirror M turns forces by M and rates by -M; on many vehicles M of the forces does not show.
    """
    relative = gyroscope @ np.linalg.inv(accelerometer)
    turns = np.linalg.det(relative) > 0.0 and not np.allclose(relative, np.eye(3))
    return bool(np.allclose(relative, -np.eye(3)) or turns)


def _describe_mount(fault: AxesFault) -> str:
    if fault.by_course:
        return (
            "the vehicle moves at one angle to base_frame's x axis, which is not forward: unless "
            f"it reverses, and if it moves along its nose, {_remount(fault.mount)}"
        )
    text = f"gravity is not along base_frame's z axis: {_remount(fault.mount)}"
    if np.allclose(fault.mount[2], [0.0, 0.0, 1.0], atol=0.1):  # FRD axes
        text += ", or let the driver publish forward-left-up axes"
    if fault.at_rest:
        text += f"; if {RATE} has the right axes, negate {ACCELERATION} instead"
    return text


def _remount(mount: Array) -> str:
    """Return the remedy of a wrong mount, by the right one, (3, 3)."""
    rpy = rpy_from_quat(quat_from_matrix(FLIP @ mount))
    if np.abs(np.sin(2.0 * rpy)).max() > 1e-3:  # no right angles: as far as they are measured
        rpy = np.round(rpy, 2)
    angles = ", ".join(f"{angle + 0.0:.4g}" for angle in np.where(np.abs(rpy) < 1e-6, 0.0, rpy))
    return f"set imu.mount_rpy to [{angles}]"


def _describe_axes(accelerometer: Array, gyroscope: Array) -> str:
    """Return what to do with readings, by the factors (3, 3) that they need."""
    if np.allclose(accelerometer, gyroscope):
        return _describe_matrix(accelerometer, f"{ACCELERATION} and {RATE}")
    parts = [
        _describe_matrix(matrix, name)
        for matrix, name in ((accelerometer, ACCELERATION), (gyroscope, RATE))
        if not np.allclose(matrix, np.eye(3))
    ]
    return " and ".join(parts)


def _describe_matrix(matrix: Array, name: str) -> str:
    """Return what a signed permutation (3, 3) does to a vector of the message."""
    diagonal = matrix.diagonal()
    if np.all(np.abs(diagonal) > 0.5):
        axes = [axis for axis, d in zip("xyz", diagonal, strict=True) if d < 0.0]
        return f"{' and '.join(axes) if len(axes) < 3 else 'all axes'} of {name} reversed"
    off = [axis for axis, d in zip("xyz", diagonal, strict=True) if abs(d) < 0.5]
    return f"{' and '.join(off)} of {name} exchanged"
