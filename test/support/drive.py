"""A simulated flight, given to the estimator message by message."""

from __future__ import annotations

from typing import Any

import numpy as np
from support.scenes import scene

from hybrid_ins import parameters
from hybrid_ins.bags.messages import new_message
from hybrid_ins.ros.estimator.estimator import Estimator
from hybrid_ins.ros.messages.cdr import ImuFields
from hybrid_ins.ros.messages.conversions import FLIP, set_stamp
from hybrid_ins.ros.messages.trajectory import Trajectory
from hybrid_ins.simulation.motions import Motion, quadrotor_flight

EPOCH_NS = 1_700_000_000_000_000_000
GIVEN = {"alignment.heading_source": "parameter", "alignment.yaw": np.pi / 2 - 0.7}
"""The heading is given; the clock is searched for."""
KNOWN = {**GIVEN, "gnss.time_offset.estimate": False}
"""The clock is given, too: one filter from the start on, in a third of the time."""


class Drive:
    """A flight fed message by message, a quadrotor's where no other ``motion`` is given."""

    def __init__(self, motion: Motion | None = None, **values: Any) -> None:
        self.log: list[tuple[str, str]] = []
        self.estimator = Estimator(
            {**parameters.defaults(), **values}, lambda level, text: self.log.append((level, text))
        )
        flight = scene(motion or quadrotor_flight(60.0, 4, heading=0.7), seed=3)
        self.truth = flight.truth
        self.force, self.rate = flight.force @ FLIP, flight.rate @ FLIP
        self.fix_t, self.fix_lla = flight.fix_t, flight.fix_lla
        self.track = Trajectory.from_navigation(
            np.zeros(len(self.truth.t), np.int64),
            self.truth.lla,
            self.truth.velocity_n,
            self.truth.quat_xyzw,
            datum_lla=self.fix_lla[0],
        )
        self.shift_ns = 0
        self.delay = 0.0  # s, of the fixes
        self.published = 0
        self.odometry = np.zeros(85)  # the last, in map

    def stamp(self, t: float) -> int:
        return EPOCH_NS + round(t * 1e9) + self.shift_ns

    def play(self, start: float, stop: float, force: Any = None, with_fixes: bool = True) -> None:
        k = int(np.searchsorted(self.fix_t, start - self.delay))
        for i in np.flatnonzero((self.truth.t >= start) & (self.truth.t < stop)):
            t = float(self.truth.t[i])
            f = self.force[i] if force is None else force(self.force[i])
            odometry = self.estimator.handle_imu(
                ImuFields(self.stamp(t), tuple(f.tolist()), tuple(self.rate[i].tolist()))
            )
            if odometry is not None:
                self.odometry = odometry.in_map
                self.published += 1
            self.estimator.run_periodic()
            while with_fixes and k < len(self.fix_t) and self.fix_t[k] + self.delay <= t:
                self.fix(k)
                k += 1

    def fix(self, k: int) -> None:
        message = new_message("sensor_msgs/msg/NavSatFix")
        set_stamp(message.header.stamp, self.stamp(float(self.fix_t[k])))
        message.latitude, message.longitude = np.degrees(self.fix_lla[k, :2]).tolist()
        message.altitude = float(self.fix_lla[k, 2])
        message.position_covariance = np.diag([0.01, 0.01, 0.02]).ravel()
        message.position_covariance_type = 2
        self.estimator.handle_fix(message)

    def error(self, t: float) -> float:
        i = int(np.argmin(np.abs(self.truth.t - t)))
        return float(np.linalg.norm(self.odometry[:3] - self.track.position_enu[i]))

    def warnings(self) -> list[str]:
        return [text for level, text in self.log if level == "warn"]

    def status(self, name: str) -> Any:
        t_ns = self.estimator.navigator.last_ns
        return next(s for s in self.estimator.status.diagnostics(t_ns) if s.name.endswith(name))
