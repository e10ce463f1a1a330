"""Random messages over all their fields, fed to the estimator."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from hybrid_ins import parameters
from hybrid_ins.bags.messages import new_message
from hybrid_ins.core.inertial.state import covariance
from hybrid_ins.ros.estimator.estimator import Estimator
from hybrid_ins.ros.messages.cdr import ImuFields
from hybrid_ins.ros.messages.conversions import set_stamp
from hybrid_ins.ros.reporting.reports import Diagnostics, Report, Status

EPOCH_NS = 1_700_000_000_000_000_000
ODD = np.array(
    [
        math.nan,
        math.inf,
        -math.inf,
        0.0,
        -0.0,
        1.0,
        -1.0,
        1e308,
        -1e308,
        5e-324,
        1e-12,
        9.81,
        1e3,
        -1e3,
        1e9,
        90.0,
        -180.0,
        360.0,
    ]
)
FRAMES = ("", "imu_link", "base_link", "/odd//name", "é" * 40, "x" * 1000)


def numbers_of(report: Report) -> list[Any]:
    """All numbers of a report, but those in the words of a status."""
    content = report.content
    if isinstance(content, Status | Diagnostics):
        return []
    values = [getattr(content, field.name) for field in dataclasses.fields(content)]
    return [value for value in values if not isinstance(value, str)]


class Fuzzer:
    """Draws messages: a share of them sound, the others with odd values in random fields."""

    def __init__(self, seed: int, share: float) -> None:
        self.rng = np.random.default_rng(seed)
        self.share = share
        self.t_ns = EPOCH_NS
        self.fix = new_message("sensor_msgs/msg/NavSatFix")
        self.twist = new_message("geometry_msgs/msg/TwistWithCovarianceStamped")
        self.pose = new_message("geometry_msgs/msg/PoseWithCovarianceStamped")

    def odd(self, values: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        """Replace some values of an array, in a share of all calls."""
        rng = self.rng
        if rng.random() >= self.share:
            return values
        values = values.copy()
        where = rng.random(values.shape) < rng.choice([0.1, 0.5, 1.0])
        kind = rng.random()
        if kind < 0.6:
            values[where] = rng.choice(ODD, np.count_nonzero(where))
        elif kind < 0.8:
            bits = rng.integers(0, 2**64, np.count_nonzero(where), np.uint64)
            values[where] = bits.view(np.float64)
        else:
            values[where] *= 10.0 ** rng.uniform(-6.0, 6.0, np.count_nonzero(where))
        return values

    def stamp(self, step_ns: int) -> int:
        """Move the clock on; the stamp is odd now and then, and the clock jumps seldom."""
        rng = self.rng
        self.t_ns += step_ns
        if rng.random() > 0.02 * self.share:
            return self.t_ns
        kind = rng.integers(6)
        if kind == 0:
            self.t_ns = EPOCH_NS + int(rng.integers(-(10**12), 10**12))  # for good
        return [
            self.t_ns,
            0,
            self.t_ns - step_ns,
            int(rng.integers(-(2**31), 2**31)) * 10**9,
            self.t_ns + int(rng.integers(-(10**10), 10**10)),
            -1,
        ][kind]

    def frame(self) -> str:
        return FRAMES[self.rng.integers(len(FRAMES))] if self.rng.random() < 1e-3 else "imu_link"

    def imu(self) -> ImuFields:
        v = self.odd(
            np.concatenate(
                (
                    [0.0, 0.0, 0.0, 1.0, 0.0],
                    self.rng.normal(0.0, 0.02, 3),
                    [0.0],
                    self.rng.normal([0.3, 0.0, 9.8], 0.3),
                    [0.0],
                )
            )
        )
        x = v.tolist()
        return ImuFields(
            self.stamp(5_000_000),
            tuple(x[9:12]),
            tuple(x[5:8]),
            self.frame(),
            tuple(x[:4]),
            x[12],
            x[8],
            x[4],
        )

    def navsat(self) -> Any:
        v = self.odd(np.concatenate(([32.0, 34.8, 20.0], np.eye(3).ravel())))
        v[:2] += self.rng.normal(0.0, 1e-6, 2)
        message, stamp = self.fix, self.stamp(0)
        set_stamp(message.header.stamp, stamp)
        message.header.frame_id = self.frame()
        message.latitude, message.longitude, message.altitude = v[:3].tolist()
        message.position_covariance = v[3:]
        message.position_covariance_type, message.status.status = 2, 0
        if self.rng.random() < 0.3 * self.share:
            message.position_covariance_type = int(self.rng.integers(0, 256))
            message.status.status = int(self.rng.integers(-128, 128))
        return message

    def velocity(self) -> Any:
        v = self.odd(np.concatenate((self.rng.normal(0.0, 0.3, 6), np.eye(6).ravel())))
        message = self.twist
        set_stamp(message.header.stamp, self.stamp(0))
        linear, angular = message.twist.twist.linear, message.twist.twist.angular
        linear.x, linear.y, linear.z, angular.x, angular.y, angular.z = v[:6].tolist()
        message.twist.covariance = v[6:]
        return message

    def initial_pose(self) -> Any:
        v = self.odd(np.concatenate(([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], np.eye(6).ravel())))
        q = self.pose.pose.pose.orientation
        q.x, q.y, q.z, q.w = v[:4].tolist()
        self.pose.pose.covariance = v[7:]
        return self.pose


def feed(estimator: Estimator, fuzzer: Fuzzer, count: int) -> int:
    """Feed messages; returns how many Imu messages renewed the odometry."""
    rng, renewed = fuzzer.rng, 0
    kinds = rng.choice(4, count, p=[0.949, 0.035, 0.0155, 0.0005])
    for k, kind in enumerate(kinds.tolist()):
        if kind == 0:
            odometry = estimator.handle_imu(fuzzer.imu())
            if odometry is not None:
                renewed += 1
                assert np.isfinite(odometry.in_map).all()
                assert np.isfinite(odometry.in_odom).all()
            estimator.run_periodic()
        elif kind == 1:
            estimator.handle_fix(fuzzer.navsat())
        elif kind == 2:
            estimator.handle_velocity(fuzzer.velocity())
        else:
            estimator.handle_initial_pose(fuzzer.initial_pose())
        for report in estimator.pop_reports():
            for numbers in numbers_of(report):
                assert np.isfinite(numbers).all(), report
        if k % 200 == 0:
            for running in estimator.navigator.phases.filters:
                assert np.linalg.eigvalsh(covariance(running.nav)).min() > 0.0
    return renewed


def run(seed: int, share: float, count: int, **values: Any) -> tuple[Estimator, int]:
    estimator = Estimator(
        {**parameters.defaults(), "alignment.heading_source": "parameter", **values},
        lambda level, text: None,
    )
    return estimator, feed(estimator, Fuzzer(seed, share), count)
