"""
An antenna that nobody has placed: it is taken to be where the motion shows it.

`hybrid_ins.core.sensor_errors.lever_arm` estimates that beside the filter which runs. A search for
the clock offset does not delay it: that of a slow vehicle may never end. A place that was given
stays: who says where the antenna is decides what the odometry is of. Where nobody has placed the
IMU either, the odometry remains that of the antenna, which fixes show; its attitude is right.
"""

from __future__ import annotations

import numpy as np

from hybrid_ins.core.filter.events import AntennaShift
from hybrid_ins.core.filter.ins_filter import NEVER_NS
from hybrid_ins.core.navigator.heading_check import is_confirmed
from hybrid_ins.core.navigator.navigator import Navigator
from hybrid_ins.ros.placement.sensor_placement import SensorPlacement
from hybrid_ins.ros.reporting.input_log import InputLog
from hybrid_ins.ros.review.axes_monitor import describe_antenna

LEAST_ERROR = 0.3  # m: a smaller one does little to the state, and is considered


class AntennaCorrection:
    """
    Moves such an antenna.

    Parameters
    ----------
    navigator : Navigator
        Its filter shows the place.
    placement : SensorPlacement
        Where the antenna is taken to be.
    inputs : InputLog
        Warns when it is moved for the first time.
    """

    def __init__(self, navigator: Navigator, placement: SensorPlacement, inputs: InputLog) -> None:
        self._navigator = navigator
        self._placement = placement
        self._inputs = inputs

    def run_periodic(self) -> bool:
        """Do what is due, some times a second; return whether the antenna was moved."""
        phases, placement = self._navigator.phases, self._placement
        running, bank = phases.filter, phases.phase.bank
        if running is None or placement.antenna_is_placed:
            return False
        error_b, std, _, is_certain = running.lever_arm
        if not is_certain or np.linalg.norm(error_b) < LEAST_ERROR:
            return False
        if bank is not None and not (bank.clock_open and is_confirmed(running, bank)):
            return False  # the heading is still checked
        fix_waits = running.next_event_ns < NEVER_NS  # for the IMU, with the place so far
        if fix_waits or running.record is not None:  # a smoother finds it by itself
            return False
        after_ns, moves_odometry = running.update.corrected_ns + 1, placement.imu_is_placed
        running.submit(AntennaShift(after_ns, error_b, moves_odometry))
        phases.kept.keep_antenna(running)
        phases.open_clock(phases.clock_open)  # a search begins anew, from filters that know
        is_first = not placement.antenna_error_b.any()
        placement.move_antenna(error_b, std, moves_odometry)
        if is_first:
            moved = describe_antenna(placement.antenna_error_b, placement.antenna_std)
            self._inputs.count_and_warn("gnss/fix", moved)
        return True
