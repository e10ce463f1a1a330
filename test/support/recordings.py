"""Trajectories with analytic figures and bags of them, for tests of evaluation and plotting."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybrid_ins.bags.messages import new_message
from hybrid_ins.bags.writer import BagWriter
from hybrid_ins.cli.evaluate import main
from hybrid_ins.core.inertial import rotations
from hybrid_ins.core.inertial.earth import LocalFrame
from hybrid_ins.evaluation.run import Fixes, Run, SensorErrors, Series, Verdicts
from hybrid_ins.ros.messages.cdr import OdometryEncoder
from hybrid_ins.ros.messages.conversions import SWAP
from hybrid_ins.ros.messages.trajectory import Trajectory

START_NS = 1_700_000_000_000_000_000
DATUM = np.array([np.radians(32.1), np.radians(34.8), 0.0])
ODOMETRY = "nav_msgs/msg/Odometry"


def stamps(seconds: Any) -> np.ndarray:
    return START_NS + np.rint(1e9 * np.asarray(seconds, float)).astype(np.int64)


def flight(seconds: Any, speed: float = 10.0) -> Trajectory:
    """Eastward at constant speed, nose to the north, level."""
    t = np.asarray(seconds, float)
    east = np.array([1.0, 0.0, 0.0])
    nose_north = rotations.quat_from_rpy(0.0, 0.0, np.pi / 2)
    return Trajectory(
        stamps(t),
        speed * t[:, None] * east,
        np.tile(speed * east, (len(t), 1)),
        np.tile(nose_north, (len(t), 1)),
        datum_lla=DATUM,
    )


def with_sigma(track: Trajectory, sigma: float) -> Trajectory:
    cov = np.tile(sigma**2 * np.eye(3), (len(track), 1, 1))
    return replace(track, position_cov=cov, velocity_cov=cov, attitude_cov=cov)


def shifted(track: Trajectory, by: Any) -> Trajectory:
    return replace(track, position_enu=track.position_enu + np.asarray(by))


def verdicts(seconds: Any, **columns: Any) -> Verdicts:
    """Return accepted position fixes, except as `columns` say."""
    usual = {"kind": "position", "accepted": True, "reason": "", "nis": 3.0, "dof": 3.0,
             "threshold": 16.3, "time_offset": 0.0}  # fmt: skip
    rows = []
    for i, stamp in enumerate(stamps(seconds)):
        given = {**usual, **{k: v[i] for k, v in columns.items()}}
        rows.append((int(stamp), *(given[name] for name in usual)))
    return Verdicts.of(rows)  # type: ignore[arg-type]


FAST = np.arange(0.0, 20.005, 0.01)
TRUTH = np.arange(0.0, 20.05, 0.1)


def navsatfix(stamp_ns: int, lla: np.ndarray, status: int = 0) -> Any:
    message = new_message("sensor_msgs/msg/NavSatFix")
    set_stamp(message, stamp_ns)
    message.latitude, message.longitude = np.degrees(lla[:2]).tolist()
    message.altitude = float(lla[2])
    message.status.status = status
    return message


def set_stamp(message: Any, stamp_ns: int) -> None:
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(int(stamp_ns), 10**9)


def write_track(
    out: BagWriter, topic: str, track: Trajectory, frames: tuple[str, str] = ("map", "base_link")
) -> None:
    """Write a track as nav_msgs/Odometry; parts that it lacks stay zero."""
    encoder = OdometryEncoder(*frames)
    for i, stamp_ns in enumerate(track.stamp_ns):
        pose_cov, twist_cov = np.zeros((6, 6)), np.zeros((6, 6))
        quat, velocity = np.zeros(4), np.zeros(3)
        if track.quat_xyzw is not None:
            quat = track.quat_xyzw[i]
            C_base_map = rotations.matrix_from_quat(rotations.quat_conjugate(quat))
            if track.velocity_enu is not None:
                velocity = C_base_map @ track.velocity_enu[i]
            if track.velocity_cov is not None:
                twist_cov[:3, :3] = track.velocity_cov[i]
        if track.position_cov is not None:
            pose_cov[:3, :3] = track.position_cov[i]
        if track.attitude_cov is not None:
            pose_cov[3:, 3:] = track.attitude_cov[i]
        data = encoder.encode(
            int(stamp_ns), track.position_enu[i], quat, pose_cov, velocity, np.zeros(3), twist_cov
        )
        out.write_raw(topic, ODOMETRY, data, int(stamp_ns))


def write_verdict(out: BagWriter, stamp_ns: int, **said: str) -> None:
    message = new_message("diagnostic_msgs/msg/DiagnosticStatus")
    message.name = "hybrid_ins: gnss"
    for key, value in {"stamp": str(stamp_ns), **said}.items():
        pair = new_message("diagnostic_msgs/msg/KeyValue")
        pair.key, pair.value = key, value
        message.values.append(pair)
    out.write("/gnss/verdict", message, int(stamp_ns))


@contextmanager
def bag(path: Path, truth: Trajectory | None = None) -> Iterator[BagWriter]:
    with BagWriter(path) as out:
        if truth is not None:
            write_track(out, "/truth/odometry", truth)
            if truth.datum_lla is not None:
                out.write("/truth/datum", navsatfix(START_NS, truth.datum_lla), START_NS)
            lla = LocalFrame(DATUM).lla(flight(TRUTH[::2]).position_enu @ SWAP)
            for stamp_ns, place in zip(truth.stamp_ns[::2], lla, strict=True):
                out.write("/gnss/fix", navsatfix(stamp_ns, place), int(stamp_ns))
        yield out


def run_program(
    capsys: pytest.CaptureFixture[str], status: int, *arguments: Any
) -> tuple[str, str]:
    assert main([str(a) for a in arguments]) == status
    captured = capsys.readouterr()
    assert "Traceback" not in captured.err
    return captured.out, captured.err


def series(level: float) -> Series:
    at = np.arange(0.0, 20.0, 0.2)
    values = level * (1.0 + 0.1 * np.sin(at[:, None] + np.arange(3)))
    return Series(stamps(at), values, 0.1 * np.abs(values))


def complete_run() -> Run:
    """A flight with everything: an outage, rejections of two kinds, biases, noise, its source."""
    at = np.concatenate((np.arange(0.0, 8.0, 0.2), np.arange(13.0, 20.0, 0.2)))
    accepted = np.arange(len(at)) % 11 > 0
    nis = np.where(accepted, 3.0, 400.0)
    nis[11] = np.nan
    reasons = np.where(accepted, "", np.where(np.isnan(nis), "no covariance", "gate"))
    lla = LocalFrame(DATUM).lla(flight(at).position_enu @ SWAP)
    lla[3, 2] = np.nan
    return Run(
        "a_flight",
        shifted(with_sigma(flight(FAST), 0.5), [-0.3, -0.4, 0.1]),
        flight(TRUTH),
        Fixes(stamps(at), lla),
        verdicts(at, accepted=accepted, nis=nis, reason=reasons),
        SensorErrors(series(0.1), series(1e-3), series(1e-3), series(1e-6)),
        SensorErrors(series(0.11), None, series(1.1e-3), None),
        ((START_NS, "constant"), (START_NS + 5 * 10**9, "learned")),
    )
