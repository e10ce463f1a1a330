"""Real flights in arrays, and the node's own estimator over them: bags without the files."""

from __future__ import annotations

import contextlib
import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.bags.flight_bag import GnssRecord, stamps
from hybrid_ins.bags.messages import new_message
from hybrid_ins.calibration.innovations import POSITION
from hybrid_ins.calibration.recording import Recording
from hybrid_ins.core.imu.samples import ImuRing
from hybrid_ins.core.inertial.rotations import matrix_from_quat
from hybrid_ins.core.navigator.notices import Notice
from hybrid_ins.core.noise.process_noise import NoiseEstimate
from hybrid_ins.core.smoothing.forward_record import RunRecord
from hybrid_ins.core.update.gate import Verdict
from hybrid_ins.core.update.measurements import clock_offset_ns
from hybrid_ins.dataset.column_map import load_map
from hybrid_ins.dataset.convert import DEFAULT_MAP, make_fixes, make_truth
from hybrid_ins.dataset.csv_flight import read_attitude, read_imu, read_position
from hybrid_ins.dataset.csv_table import Faults
from hybrid_ins.evaluation.evaluate import evaluate
from hybrid_ins.evaluation.result import Result, Scoring
from hybrid_ins.evaluation.run import Verdicts
from hybrid_ins.noise_regressor.reader import NoiseReader
from hybrid_ins.resources import share_path
from hybrid_ins.ros.estimator.estimator import Estimator
from hybrid_ins.ros.estimator.imu_block import handle_imu_block
from hybrid_ins.ros.estimator.smoothed import SmoothedRun
from hybrid_ins.ros.messages import conversions
from hybrid_ins.ros.messages.conversions import FLIP
from hybrid_ins.ros.messages.trajectory import Array, Stamps, Trajectory, trajectory_from_odometry
from hybrid_ins.simulation.sensors import RTK_STD

SESSIONS = {"first": (2, 3, 4, 5, 6, 7), "second": (16, 17, 18, 19, 20, 21)}
IMUS = (1, 2, 3, 4)


@dataclass(frozen=True, eq=False)
class Flight:
    """One flight with one IMU, as published."""

    name: str  # of the flight
    imu: int
    session: str
    stamp_ns: Stamps  # (N,) IMU clock
    force: Array  # (N, 3) m/s2, FLU
    rate: Array  # (N, 3) rad/s, FLU
    position: Any  # PositionSeries, reference clock
    truth: Trajectory  # reference clock
    epoch: float  # s


@dataclass(frozen=True, eq=False)
class Fixes:
    """What a receiver would have said."""

    stamp_ns: Stamps  # (M,) reference clock
    lla: Array  # (M, 3)
    std: Array  # (3,) north, east, down


@cache
def load(data: Path, number: int, imu: int) -> Flight:
    """Read one flight with one of its IMUs, as ``ins_convert`` does."""
    directory = data / "Horizontal" / f"path_{number}"
    layout = load_map(share_path(DEFAULT_MAP))
    faults = Faults()
    assert layout.attitude is not None
    with contextlib.redirect_stderr(io.StringIO()):  # ins_convert tells each faulty row
        series = read_imu(directory, layout.imu, imu, faults)
        position = read_position(directory, layout.position, faults)
        attitude = read_attitude(directory, layout.attitude, faults)
    first = GnssRecord(stamps(position.t[:1], layout.epoch), position.lla[:1], np.ones(3))
    truth = make_truth(
        position,
        layout.position.std,
        attitude,
        layout.attitude.orientation.std,
        first,
        layout.epoch,
    ).track
    session = next(name for name, numbers in SESSIONS.items() if number in numbers)
    return Flight(
        f"H{number}",
        imu,
        session,
        stamps(series.t, layout.epoch),
        series.specific_force_b @ FLIP,
        series.angular_rate_b @ FLIP,
        position,
        replace(truth, datum_lla=position.lla[0]),
        layout.epoch,
    )


def fixes(flight: Flight, rate: float, seed: int, outages: Sequence[tuple[float, float]]) -> Fixes:
    """Make fixes with the paper's noise; outages (start, duration) [s] from the first sample."""
    start = (int(flight.stamp_ns[0]) - int(flight.epoch) * 10**9) * 1e-9
    t, lla, std = make_fixes(
        flight.position,
        np.array([0.02, 0.02, 0.05]),
        rate,
        np.array(RTK_STD),
        np.random.default_rng([seed, int(flight.name[1:]), flight.imu]),
        [(start + s, duration) for s, duration in outages],
    )
    return Fixes(stamps(t, flight.epoch), lla, std)


def first_yaw(flight: Flight, offset: float) -> float:
    """Yaw of base_link in map [rad] at the first sample, by the reference."""
    truth = flight.truth
    assert truth.quat_xyzw is not None
    at = int(np.argmin(np.abs(truth.stamp_ns + round(offset * 1e9) - flight.stamp_ns[0])))
    C = matrix_from_quat(truth.quat_xyzw[at])
    return math.atan2(C[1, 0], C[0, 0])


class _Told(NoiseReader):
    """Answers with levels that it is told."""

    def __init__(
        self,
        values: Mapping[str, Any],
        mount: Array,
        log: Callable[[str, str], None],
        levels: Callable[[int], Array],
    ) -> None:
        super().__init__(values, mount, log)
        self._levels = levels

    def read(self, ring: ImuRing, t_ns: int) -> NoiseEstimate:
        """See `NoiseReader.read`."""
        return NoiseEstimate(t_ns, self._levels(t_ns))


class Recorded(Estimator):
    """Keeps the verdicts on fixes, and the noise levels in force."""

    def __init__(
        self,
        values: Mapping[str, Any],
        first_ns: int,
        told: Callable[[int], Array] | None,
        record: RunRecord | None = None,
    ) -> None:
        self.first_ns = first_ns
        self.rows: list[tuple[int, str, bool, str, float, float, float, float]] = []
        self.levels_t: list[float] = []  # s, and the levels in force then
        self.levels: list[Array] = []
        super().__init__(values, lambda level, text: None, record)
        if told is not None:
            self.noise.reader = _Told(values, self.placement.mount, self.inputs.log, told)

    def _handle_notices(self) -> None:
        running = self.navigator.filter
        if running is not None:
            self.levels_t.append((running.t_ns - self.first_ns) * 1e-9)
            self.levels.append(running.noise.levels())
        super()._handle_notices()

    def on_notice(self, notice: Notice) -> None:
        """See `Estimator`."""
        if isinstance(notice, Verdict):
            offset_ns = clock_offset_ns(notice.measurement)
            self.rows.append(
                (
                    notice.measurement.t_ns - offset_ns,
                    "position",
                    notice.accepted,
                    notice.reason,
                    notice.nis,
                    float(len(notice.sigma)),
                    notice.threshold,
                    offset_ns * 1e-9,
                )
            )
        super().on_notice(notice)


@dataclass(frozen=True, eq=False)
class Flown:
    """What came of a flight."""

    result: Result
    estimator: Recorded
    smoothed: Result | None = None


def fly(
    flight: Flight,
    aid: Fixes,
    values: Mapping[str, Any],
    *,
    offset: float,
    heading: float | None = 0.0,
    skip: float = 5.0,
    force: Array | None = None,
    rate: Array | None = None,
    told: Callable[[int], Array] | None = None,
    smooth: bool = False,
    truth_offset: float | None = None,
) -> Flown:
    """
    Run the node's estimator over a flight and judge it on epochs that it was not given.

    Parameters
    ----------
    flight, aid : Flight, Fixes
    values : mapping
        Checked parameters.
    offset : float
        Clock offset [s] by which fixes come in, and the first heading is read off the truth.
    heading : float or None
        Error of the heading given at the start [rad]; None: it has to be found.
    skip : float
        Time after the start that does not count [s].
    force, rate : ndarray, optional
        Readings in place of the flight's.
    told : callable, optional
        Gives the levels (6,) at a stamp [ns] in place of the regressor.
    smooth : bool
        Smooth the run, too.
    truth_offset : float, optional
        Of the reference's clock [s], for the judgement; the run's own estimate by default.
    """
    values = dict(values)
    if heading is not None:
        values.update(
            {
                "alignment.heading_source": "parameter",
                "alignment.yaw": first_yaw(flight, offset) + heading,
                "alignment.yaw_std": max(0.1, abs(heading)),
            }
        )
    record = RunRecord() if smooth else None
    estimator = Recorded(values, int(flight.stamp_ns[0]), told, record)
    force = flight.force if force is None else force
    rate = flight.rate if rate is None else rate
    due = aid.stamp_ns + round(offset * 1e9)
    message = new_message("sensor_msgs/msg/NavSatFix")
    message.header.frame_id = values["base_frame"]
    message.position_covariance = np.diag(aid.std[[1, 0, 2]] ** 2).ravel()
    message.position_covariance_type = 2
    done: list[tuple[NDArray[np.int64], Array]] = []
    start = 0
    for k in range(len(due)):
        stop = int(np.searchsorted(flight.stamp_ns, due[k], side="right"))
        if stop > start:
            done += [
                (t, v)
                for t, v, _ in handle_imu_block(
                    estimator, flight.stamp_ns[start:stop], force[start:stop], rate[start:stop]
                )
            ]
            start = stop
        conversions.set_stamp(message.header.stamp, int(aid.stamp_ns[k]))
        message.latitude, message.longitude = np.degrees(aid.lla[k, :2]).tolist()
        message.altitude = float(aid.lla[k, 2])
        estimator.handle_fix(message)
        estimator.pop_reports()
    done += [
        (t, v)
        for t, v, _ in handle_imu_block(
            estimator, flight.stamp_ns[start:], force[start:], rate[start:]
        )
    ]

    def judge(stamps: Sequence[Stamps], odometry: Sequence[Array], verdicts: Verdicts) -> Result:
        track, _ = trajectory_from_odometry(np.concatenate(stamps), np.concatenate(odometry))
        return evaluate(
            replace(track, datum_lla=aid.lla[0]),
            flight.truth,
            fix_stamp_ns=aid.stamp_ns,
            verdicts=verdicts,
            scoring=Scoring(skip=skip, time_offset=truth_offset),
        )

    verdicts = Verdicts.of(estimator.rows)
    result = judge([t for t, _ in done], [v for _, v in done], verdicts)
    if record is None:
        return Flown(result, estimator)
    # Judged on the same epochs: the time before the filter ran, which it has too, does not count.
    first_ns = int(done[0][0][0])
    smoothed = SmoothedRun(estimator, record, lambda length: {})
    blocks = [block for block, _ in smoothed.states()]
    stamps = np.concatenate([block.t_ns for block in blocks])
    odometry = np.concatenate([block.in_map for block in blocks])
    kept = stamps >= first_ns
    hindsight = replace(verdicts, time_offset=smoothed.clock_offsets(verdicts.stamp_ns))
    return Flown(result, estimator, judge([stamps[kept]], [odometry[kept]], hindsight))


def as_recording(flight: Flight, aid: Fixes) -> Recording:
    """Return what ``ins_calibrate`` would read from the bag."""
    origin = int(flight.stamp_ns[0])
    count = len(aid.stamp_ns)
    return Recording(
        f"{flight.name}/{flight.imu}",
        (flight.stamp_ns - origin) * 1e-9,
        np.ascontiguousarray(np.hstack((flight.force @ FLIP, flight.rate @ FLIP))),
        (aid.stamp_ns - origin) * 1e-9,
        np.full(count, POSITION),
        aid.lla,
        np.tile(np.diag(aid.std**2), (count, 1, 1)),
    )
