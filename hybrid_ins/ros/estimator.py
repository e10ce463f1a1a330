"""
What the node and ``ins_replay`` share: messages in, the navigator inside, messages out.

Owns no topic, no file and no clock: time is the stamps of the IMU samples. Whoever owns it feeds
it, and takes what it has to say from ``outbox`` and, at IMU rate, from ``odometry``.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_ins import parameters
from hybrid_ins.core import chi_square
from hybrid_ins.core.alignment import AlignmentSettings
from hybrid_ins.core.clock_search import ClockSearch
from hybrid_ins.core.events import ClockShift, NoiseChange
from hybrid_ins.core.filter_noise import FilterNoise
from hybrid_ins.core.gate import Gate
from hybrid_ins.core.ins_filter import FilterSettings, InsFilter
from hybrid_ins.core.measurements import Measurement
from hybrid_ins.core.multiple_model import Decision
from hybrid_ins.core.navigator import STAMP_FAULTS, Navigator
from hybrid_ins.core.noise import (
    PAPER_CONSTANTS,
    ConstantNoise,
    LearnedNoise,
    NoiseModel,
    ProcessNoise,
)
from hybrid_ins.core.noise_innovation import InnovationNoise
from hybrid_ins.core.noise_multiple_model import NoiseMultipleModelBank
from hybrid_ins.core.samples import SAMPLE_DTYPE, steps_since
from hybrid_ins.core.state import COVARIANCE, DIAGONAL, N_NAV
from hybrid_ins.noise_regressor.reader import NoiseReader
from hybrid_ins.ros import cdr, conversions, odom_frame, output
from hybrid_ins.ros.cdr import ImuFields, Status
from hybrid_ins.ros.conversions import FLIP, GnssInput, MapFrame, Message, NewMessage, Refused
from hybrid_ins.ros.static_transforms import StaticTransforms

Array = NDArray[np.float64]
Log = Callable[[str, str], None]

REPORT_NS = 100_000_000  # biases, variances and the filtered fix
DIAGNOSTICS_NS = 1_000_000_000
DEAD_RECKONING_AFTER = 2.0  # s without a fused fix
CLOCK_NS = 1_000_000_000  # between two corrections of the clock offset
CLOCK_USABLE, CLOCK_SETTLED = 0.1, 0.015  # s, standard deviations
CLOCK_WRONG = 0.03  # s, of an offset that the user should know of
CLOCK_AGAIN_NS = 30_000_000_000  # after a search, before another one on a suspicion
DISAGREEMENT = 3.0  # factor on the noise of IMU or fixes that the user should know of
WAITING = {"imu": "waiting for the IMU", "gnss": "waiting for GNSS", "heading": "finding heading"}
Stretch = tuple[NDArray[np.int64], Array, Array]


class Estimator:
    """
    An INS/GNSS estimator for ROS messages.

    Parameters
    ----------
    values : mapping
        Checked parameters, see `parameters.check_all`.
    log : callable
        Called with a level (info, warn, error) and a line for the user.

    Attributes
    ----------
    outbox : deque of (str, bytes)
        Topic and serialised message, for the owner to publish and remove.
    odometry : ndarray, shape (85,)
        What an Odometry message says after the last sample (`ros.output.odometry_values`).
    local : ndarray, shape (85,)
        The same in ``odom`` (`ros.odom_frame`).
    counts : Counter
        Everything refused, by name.
    ever_aligned : bool
        The filter ran at some time.
    fixes_fused : int
        Measurements that the filter took.
    """

    def __init__(self, values: Mapping[str, Any], log: Log) -> None:
        self.values = dict(values)
        self.outbox: deque[tuple[str, bytes]] = deque()
        self.odometry = np.zeros(output.N_ODOMETRY)
        self.local = np.zeros(output.N_ODOMETRY)
        self._log = log
        self._ahead: tuple[NDArray[np.int64], Array, Array] | None = None
        self._map: MapFrame | None = None
        self._local_state = odom_frame.start()
        self._local_ns = 0  # of the last sample in odom; 0: the filter has just started
        self._transforms = StaticTransforms()
        self._clock_moved = 0.0  # s, by estimation
        self._clock_settled: float | None = None  # s, offset once it was known well
        self._searched_ns = 0
        self._clock_ns = 0
        self._offsets: dict[tuple[str, int], float] = {}  # of measurements not yet decided
        self._frames = {"imu/data": "", "gnss/fix": ""}  # that messages come in
        self._place_sensors()
        self._limits = (values["imu.max_specific_force"], values["imu.max_angular_rate"])
        self.navigator = Navigator(
            AlignmentSettings(
                values["alignment.heading_source"],
                conversions.yaw_ned_from_enu(values["alignment.yaw"]),
                values["alignment.yaw_std"],
                values["alignment.course_min_speed"],
                values["alignment.window"],
                *conversions.first_biases(values),
            ),
            FilterSettings(values["covariance_interval"], values["gnss.max_delay"]),
            self._make_noise,
            self._make_gate,
            values["imu.max_gap"],
            values["imu.zero_updates"],
            self._start_over,
            self._add_to_stamps,
        )
        self.navigator.open_clock(values["gnss.time_offset.estimate"])
        self.counts: Counter[str] = self.navigator.counts
        self._reader = self._make_reader()
        frame = (values["base_frame"],)
        self._filtered_fix = cdr.FixEncoder(values["base_frame"], conversions.KNOWN)
        self._biases = cdr.StampedEncoder(frame, output.N_BIAS)
        self._variances = cdr.StampedEncoder(frame, 3)
        self._tick_ns = 1  # what is due at the next sample; none has come yet
        self._report_ns = self._diagnostics_ns = self._refresh_ns = 0
        self._fused_ns = 0
        self.fixes_fused = 0
        self._aligned = False
        self.ever_aligned = False
        if values["datum"]:
            lat, lon, height = values["datum"]
            self._set_datum(np.array([math.radians(lat), math.radians(lon), height]), 1)

    # Parameters become parts of the filter.

    def _make_noise(self, period: float) -> FilterNoise:
        process = self._make_process(period)
        factors = None
        if self.values["noise.mode"] == "learned" and self.values["noise.innovation_scale"]:
            factors = NoiseMultipleModelBank()
        return FilterNoise(self._make_noise_model(process), process, factors)

    def _make_noise_model(self, process: ProcessNoise) -> NoiseModel:
        mode = self.values["noise.mode"]
        constant = np.repeat(
            (self.values["noise.q_accelerometer"], self.values["noise.q_gyroscope"]), 3
        )
        if mode in PAPER_CONSTANTS:
            return ConstantNoise(np.repeat(PAPER_CONSTANTS[mode], 3))
        if mode == "learned":
            return LearnedNoise(
                constant,
                np.concatenate(
                    (
                        self.values["noise.background_accelerometer"],
                        self.values["noise.background_gyroscope"],
                    )
                ),
            )
        if mode in ("innovation", "innovation_literal"):
            floor = np.repeat(
                (self.values["noise.q_accelerometer_min"], self.values["noise.q_gyroscope_min"]), 3
            )
            return InnovationNoise(
                constant,
                floor,
                self.values["noise.innovation_window"],
                process,
                mode == "innovation_literal",
            )
        return ConstantNoise(constant)

    def _make_reader(self) -> NoiseReader | None:
        if self.values["noise.mode"] != "learned":
            return None
        reader = NoiseReader(self.values, self._mount, self._log)
        if self._ahead is not None:
            reader.foresee(*self._ahead)
        return reader

    def foresee(self, t_ns: NDArray[np.int64], force: Array, rate: Array) -> None:
        """Tell what `imu_block` will be given, where it is known; see `NoiseReader.foresee`."""
        self._ahead = t_ns, force, rate
        if self._reader is not None:
            self._reader.foresee(*self._ahead)

    def _make_process(self, period: float) -> ProcessNoise:
        walk_a = self.values["imu.accelerometer_bias_walk"]
        walk_g = self.values["imu.gyroscope_bias_walk"]
        return ProcessNoise(
            np.array([walk_a**2] * 3 + [walk_g**2] * 3),
            period,
            self.values["noise.units"] == "consistent",
        )

    def _make_gate(self) -> Gate:
        probability = self.values["gnss.gate_probability"]
        return Gate(
            {m: chi_square.quantile(probability, m) for m in (1, 2, 3, 6)},
            self.values["gnss.patience"],
        )

    def _place_sensors(self) -> None:
        """Take mount and lever arm from the parameters, or from fixed transforms without them."""
        values = dict(self.values)
        mount = conversions.mount_matrix(values["imu.mount_rpy"])
        if not any(values["imu.position"]) and not any(values["imu.mount_rpy"]):
            C, position = self._find_frame("imu/data")
            mount, values["imu.position"] = FLIP @ C, position.tolist()
        if not any(values["gnss.antenna_position"]):
            values["gnss.antenna_position"] = self._find_frame("gnss/fix")[1].tolist()
        self._mount = mount
        self._turn = tuple(mount.ravel().tolist())
        self._arm_b = FLIP @ np.array(values["imu.position"])
        values["gnss.time_offset.value"] += self._clock_moved
        self._gnss = GnssInput.from_parameters(values)

    def _find_frame(self, topic: str) -> tuple[Array, Array]:
        """Rotation and place in the base frame of the frame that a topic's messages come in."""
        base, frame = self.values["base_frame"], self._frames[topic]
        found = None
        if frame and self.values["use_tf_static"]:
            found = self._transforms.find(base, frame)
        return (np.eye(3), np.zeros(3)) if found is None else found

    def take_frame(self, topic: str, frame: str) -> None:
        """Take the frame_id of the messages on ``imu/data`` or ``gnss/fix``."""
        known, self._frames[topic] = self._frames[topic], frame
        if known and frame != known:
            self.remark(
                topic,
                Refused(
                    f"{topic}: frame_id changes",
                    f"frame_id changes from '{known}' to '{frame}': two publishers on one topic?",
                ),
            )
        base = self.values["base_frame"]
        names = (
            ("imu.position", "imu.mount_rpy") if topic == "imu/data" else ("gnss.antenna_position",)
        )
        if (
            not known
            and frame not in ("", base)
            and not any(any(self.values[name]) for name in names)
            and (self._transforms.find(base, frame) is None)
        ):
            self._log(
                "info",
                f"{topic}: comes in frame '{frame}', which neither {names[0]} nor "
                f"/tf_static places in '{base}': taken to be there, with the same axes",
            )
        self._move_sensors()

    def static_transforms(self, message: Message) -> None:
        """Take a tf2_msgs/TFMessage of /tf_static."""
        self._transforms.add(message)
        self._move_sensors()

    def _move_sensors(self) -> None:
        before = self._mount, self._arm_b, self._gnss.lever_b
        self._place_sensors()
        if all(map(np.array_equal, before, (self._mount, self._arm_b, self._gnss.lever_b))):
            return
        self._log(
            "info",
            f"sensors placed by /tf_static: IMU and antenna in '{self.values['base_frame']}'",
        )
        self._reader = self._make_reader()
        if self.navigator.ring.count:
            self.navigator.reset()
            self._start_over()

    def change(self, changes: Mapping[str, Any]) -> None:
        """Take checked values of run-time parameters without losing the state."""
        self.values.update(changes)
        if "gnss.time_offset.value" in changes:
            self._clock_moved, self._clock_settled = 0.0, None
        if changes.keys() & {"gnss.time_offset.value", "gnss.time_offset.estimate"}:
            self.navigator.open_clock(self.values["gnss.time_offset.estimate"])
        self._place_sensors()
        for running in self.navigator.filters:
            running.gate = self._make_gate()
            if any(name.startswith("noise.") or name.endswith("_bias_walk") for name in changes):
                noise = self._make_noise(running.noise.process.period)
                running.submit(NoiseChange(running.t_ns, noise))
        if any(name.startswith("noise.") for name in changes):
            self._reader = self._make_reader()

    # Messages in.

    @property
    def aligned(self) -> bool:
        """The filter runs and odometry is valid."""
        return self._map is not None and self.navigator.filter is not None

    def imu_message(self, imu: ImuFields, received_ns: int | None = None) -> bool:
        """Take one Imu message; True when ``odometry`` was renewed."""
        if imu.frame_id != self._frames["imu/data"]:
            self.take_frame("imu/data", imu.frame_id)
        if imu.specific_force_cov0 == -1.0 or imu.angular_rate_cov0 == -1.0:
            self.imu_without_reading()
            return False
        if self.wants_orientation and imu.orientation_cov0 != -1.0:
            self.orientation(imu.orientation_xyzw)
        t_ns = imu.stamp_ns
        if received_ns is not None and self.values["use_receive_time"]:
            t_ns = received_ns
        return self.imu(t_ns, imu.specific_force, imu.angular_rate)

    def imu_without_reading(self) -> None:
        """Take an Imu message whose covariances say that it carries no reading."""
        self.remark(
            "imu/data",
            Refused(
                "imu: no reading",
                "covariance[0] is -1: the message says that it carries no "
                "acceleration or no angular rate",
            ),
        )

    def imu(
        self,
        t_ns: int,
        force: tuple[float, float, float],
        rate: tuple[float, float, float],
    ) -> bool:
        """
        Take one Imu message's readings, in its own axes (FLU unless mounted otherwise).

        Returns True when ``odometry`` was renewed; `tick` is due once that is published.
        """
        fx, fy, fz = force
        wx, wy, wz = rate
        most_f, most_w = self._limits
        # A NaN fails every comparison.
        if not (
            -most_f <= fx <= most_f
            and -most_f <= fy <= most_f
            and -most_f <= fz <= most_f
            and -most_w <= wx <= most_w
            and -most_w <= wy <= most_w
            and -most_w <= wz <= most_w
            and t_ns > 0
            and (fx or fy or fz)
        ):
            self._refuse_imu(t_ns, force, rate)
            return False
        xx, xy, xz, yx, yy, yz, zx, zy, zz = self._turn
        navigator = self.navigator
        if not navigator.imu(
            t_ns,
            xx * fx + xy * fy + xz * fz,
            yx * fx + yy * fy + yz * fz,
            zx * fx + zy * fy + zz * fz,
            xx * wx + xy * wy + xz * wz,
            yx * wx + yy * wy + yz * wz,
            zx * wx + zy * wy + zz * wz,
        ):
            name = navigator.refusal
            self.remark("imu/data", Refused(name, STAMP_FAULTS[name]))
            return False
        running = navigator.filter
        if running is None or self._map is None:
            return False
        output.odometry_values(
            running.nav,
            self._map.origin_e,
            self._map.C_me,
            self._arm_b,
            self._rate_variance,
            self.odometry,
        )
        if not math.isfinite(self.odometry.item(3) + self.odometry.item(7)):
            navigator.give_up("the state was lost: it is no number any more")
            return False
        dt = (t_ns - self._local_ns) * 1e-9 if self._local_ns else 0.0
        self._local_ns = t_ns
        odom_frame.advance(self._local_state, dt, self.odometry, self.local)
        return True

    def fill_transforms(self, transforms: Sequence[Message]) -> None:
        """Fill two geometry_msgs/TransformStamped: map→odom and odom→base of the last sample."""
        odom = self.values["odom_frame"]
        origin, yaw = odom_frame.map_from_odom(self.odometry, self.local)
        turn = (0.0, 0.0, math.sin(0.5 * yaw), math.cos(0.5 * yaw))
        first, second = transforms
        conversions.fill_transform(
            first, self._local_ns, self.values["map_frame"], odom, origin, turn
        )
        conversions.fill_transform(
            second, self._local_ns, odom, self.values["base_frame"], self.local[:3], self.local[3:7]
        )

    def imu_block(
        self,
        t_ns: NDArray[np.int64],
        force: Array,
        rate: Array,
        orientation_xyzw: Array | None = None,
    ) -> list[Stretch]:
        """
        Take many samples, shapes (N,), (N, 3), (N, 3); the result is that of `imu` one by one.

        Returns the stamps (n,), odometry values (n, 85) and local ones (n, 85) of each stretch in
        which the filter ran. Orientations (N, 4) matter to heading_source imu only.
        """
        done: list[Stretch] = []
        steady_ns, remarkable, k = 0, [0], 0
        while k < len(t_ns):
            navigator = self.navigator
            if steady_ns != navigator.steady_ns:
                steady_ns = navigator.steady_ns
                remarkable = self._remarkable(t_ns, force, rate)
            end = remarkable[bisect_left(remarkable, k)]
            step = int(t_ns[k]) - navigator.last_ns
            if not self.aligned or end == k or not 0 < step <= steady_ns:
                if orientation_xyzw is not None and self.wants_orientation:
                    self.orientation(tuple(orientation_xyzw[k].tolist()))
                if self.imu(int(t_ns[k]), tuple(force[k].tolist()), tuple(rate[k].tolist())):
                    done.append(
                        (t_ns[k : k + 1], self.odometry[None].copy(), self.local[None].copy())
                    )
                self.tick()
                k += 1
                continue
            part = slice(k, min(end, k + 1 + int(np.searchsorted(t_ns[k:end], self._next_ns))))
            done.append(self._run(t_ns[part], force[part], rate[part]))
            self.tick()
            k = part.stop
        return done

    @property
    def _next_ns(self) -> int:
        """Stamp after which more than the next sample is to be taken care of."""
        assert self.navigator.filter is not None
        return min(self._tick_ns, self.navigator.filter.next_event_ns)

    def _remarkable(self, t_ns: NDArray[np.int64], force: Array, rate: Array) -> list[int]:
        """Rows that do not plainly follow the one before, and the end."""
        most_f, most_w = self._limits
        steps = steps_since(int(t_ns[0]) - 1, t_ns)
        plain = (steps > 0) & (steps <= self.navigator.steady_ns)
        for values, most in ((force, most_f), (rate, most_w)):
            plain &= (np.abs(values) <= most).all(axis=1)
        plain &= force.any(axis=1)
        return [*(~plain).nonzero()[0].tolist(), len(t_ns)]

    def _run(self, t_ns: NDArray[np.int64], force: Array, rate: Array) -> Stretch:
        assert self._map is not None and self.navigator.filter is not None
        samples = np.empty(len(t_ns), SAMPLE_DTYPE)
        samples["t_ns"] = t_ns
        samples["f"], samples["w"] = force @ self._mount.T, rate @ self._mount.T
        rows = np.empty((len(t_ns), N_NAV))
        self.navigator.imu_block(samples, rows)
        values = np.empty((len(t_ns), output.N_ODOMETRY))
        output.odometry_block(
            rows, self._map.origin_e, self._map.C_me, self._arm_b, self._rate_variance, values
        )
        if not np.isfinite(values).all():
            self.navigator.give_up("the state was lost: it is no number any more")
            return t_ns[:0], values[:0], values[:0]
        self.odometry[:] = values[-1]
        local = np.empty_like(values)
        dt = steps_since(self._local_ns or int(t_ns[0]), t_ns) * 1e-9
        self._local_ns = int(t_ns[-1])
        odom_frame.advance_block(self._local_state, dt, values, local)
        self.local[:] = local[-1]
        return t_ns, values, local

    def orientation(self, quat_xyzw: tuple[float, float, float, float]) -> None:
        """Take the orientation of an Imu message; it matters only for the first heading."""
        if self.navigator.filter is None:
            yaw = conversions.imu_yaw(quat_xyzw, self._mount)
            if yaw is not None:
                self.navigator.alignment.observe_yaw(yaw)

    @property
    def wants_orientation(self) -> bool:
        """The Imu messages' orientation is of use now."""
        return self.navigator.filter is None and self.values["alignment.heading_source"] == "imu"

    def _by_receipt(self, received_ns: int | None) -> int | None:
        return received_ns if self.values["use_receive_time"] else None

    def fix(self, message: Message, received_ns: int | None = None) -> None:
        """Take a sensor_msgs/NavSatFix."""
        if message.header.frame_id != self._frames["gnss/fix"]:
            self.take_frame("gnss/fix", message.header.frame_id)
        fix = self._gnss.position(message, self._by_receipt(received_ns))
        if isinstance(fix, Refused):
            self.remark("gnss/fix", fix)
            return
        if self._map is None:
            lla = np.nan_to_num(fix.lla)
            self._set_datum(lla, fix.t_ns)
        self._measure(fix)

    def velocity(self, message: Message, received_ns: int | None = None) -> None:
        """Take a geometry_msgs/TwistWithCovarianceStamped with ENU components."""
        velocity = self._gnss.velocity(message, self._by_receipt(received_ns))
        if isinstance(velocity, Refused):
            self.remark("gnss/velocity", velocity)
            return
        self._measure(velocity)

    def _measure(self, measurement: Measurement) -> None:
        self._offsets[measurement.kind, measurement.t_ns] = self._gnss.time_offset
        self.navigator.measure(measurement)
        self._tell_verdicts()
        self._follow_clock()

    def _follow_clock(self) -> None:
        """Correct the clock offset now and then, or tell that it is wrong."""
        running = self.navigator.filter
        if running is None or running.t_ns < self._clock_ns:
            return
        self._clock_ns = running.t_ns + CLOCK_NS
        correcting = self.values["gnss.time_offset.estimate"] and not self.navigator.clock_open
        if correcting:
            self._correct_clock(running)
        fault = self._clock_fault()
        if fault:
            self.remark("gnss/fix", Refused("gnss: clock offset", fault))
            self._clock_settled = None
        if (
            correcting
            and (fault or _imu_disagrees(running.noise))
            and running.t_ns - self._searched_ns > CLOCK_AGAIN_NS
        ):
            self.navigator.open_clock(True)

    def _correct_clock(self, running: InsFilter) -> None:
        """Add to the fixes' stamps what a running filter has found missing."""
        missing, sigma = running.clock.residual, running.clock.sigma
        if sigma < CLOCK_USABLE and abs(missing) > max(0.3 * sigma, 1e-3):
            self._clock_moved += missing
            running.submit(ClockShift(running.t_ns, missing))
            self._place_sensors()
        if sigma < CLOCK_SETTLED and self._clock_settled is None:
            self._clock_settled = self._gnss.time_offset

    def _add_to_stamps(self, decision: Decision) -> None:
        """Add so much more to the fixes' stamps as the navigator has found."""
        self._tell_verdicts()
        self._offsets.clear()
        self._clock_moved += decision.offset
        self._place_sensors()
        self._searched_ns, self._clock_ns = self.navigator.last_ns, 0
        clock = decision.filter.clock
        self._log(
            "info",
            f"clock offset found: {self._gnss.time_offset + clock.residual:+.3f} ± "
            f"{clock.sigma:.3f} s",
        )

    def _clock_found(self) -> tuple[float, float] | None:
        """Return what is missing from the clock offset in force, and its uncertainty [s]."""
        running, bank = self.navigator.filter, self.navigator.bank
        if isinstance(bank, ClockSearch):
            return bank.clock()
        return None if running is None else (running.clock.residual, running.clock.sigma)

    def _clock_fault(self) -> str:
        """Say what is suspicious about the fixes' clock; empty where nothing is."""
        running = self.navigator.filter
        if running is None:
            return ""
        sigma = running.clock.sigma
        total = self._gnss.time_offset + running.clock.residual
        if self.values["gnss.time_offset.estimate"]:
            settled = self._clock_settled
            if settled is not None and abs(total - settled) > max(CLOCK_WRONG, 5.0 * sigma):
                return (
                    f"the clock offset moved from {settled:+.3f} s to {total:+.3f} s: do IMU "
                    "and receiver stamp by one clock?"
                )
        elif abs(running.clock.residual) > max(CLOCK_WRONG, 5.0 * sigma):
            return (
                f"gnss.time_offset.value seems to be {total:+.2f} ± {sigma:.2f} s, not "
                f"{self._gnss.time_offset:+.3f} s: run ins_calibrate, or set "
                "gnss.time_offset.estimate"
            )
        return ""

    def initial_pose(self, message: Message) -> None:
        """Take a heading by hand, a geometry_msgs/PoseWithCovarianceStamped; aligns anew."""
        yaw = conversions.initial_yaw(message)
        if isinstance(yaw, Refused):
            self.remark("initialpose", yaw)
            return
        self.navigator.realign()
        self.navigator.alignment.set_yaw(self.navigator.last_ns, *yaw)
        self._start_over()

    def reset(self) -> None:
        """Forget the state and align anew; the map stays where it is."""
        self.navigator.reset()
        self._start_over()

    def _start_over(self, reason: str = "") -> None:
        """Begin to tell anew, after the navigator did."""
        if reason:
            self._log("warn", f"{reason}: aligning anew")
        self._aligned = False
        self._local_ns = 0
        self._tick_ns = 1
        self._report_ns = self._diagnostics_ns = self._refresh_ns = 0
        self._clock_ns = self._searched_ns = 0

    # What goes wrong.

    def _refuse_imu(
        self, t_ns: int, force: tuple[float, float, float], rate: tuple[float, float, float]
    ) -> None:
        if t_ns <= 0:
            refused = Refused("imu: zero stamp", "header.stamp is zero: the driver must stamp")
        elif not np.all(np.isfinite((*force, *rate))):
            refused = Refused("imu: not finite", "NaN or inf in the reading")
        elif not any(force):
            refused = Refused(
                "imu: no acceleration",
                "acceleration is exactly zero: not even a "
                "free fall reads so; does the driver fill it?",
            )
        elif max(map(abs, force)) > self._limits[0]:
            refused = Refused(
                "imu: absurd acceleration",
                f"{max(map(abs, force)):.0f} m/s² exceeds imu.max_specific_force",
            )
        else:
            refused = Refused(
                "imu: absurd rate",
                f"{max(map(abs, rate)):.0f} rad/s exceeds "
                "imu.max_angular_rate: is the rate given in degrees?",
            )
        self.remark("imu/data", refused)

    def remark(self, topic: str, remark: Refused) -> None:
        """Count what was refused or odd; tell the first, tenth, hundredth... of its name."""
        self.counts[remark.name] += 1
        count = self.counts[remark.name]
        if count == 10 ** (len(str(count)) - 1):
            so_far = f" ({count} so far)" if count > 1 else ""
            self._log("warn", f"{topic}: {remark.text}{so_far}")

    # Messages out.

    def _set_datum(self, lla: Array, t_ns: int) -> None:
        self._map = MapFrame(lla)
        datum = cdr.FixEncoder(self.values["map_frame"], 0)
        datum.values[:3] = *np.degrees(lla[:2]), lla[2]
        self.outbox.append(("datum", datum.message(t_ns)))

    @property
    def _rate_variance(self) -> Array:
        running = self.navigator.filter
        assert running is not None
        return running.noise.levels()[3:]

    def _tell_verdicts(self) -> None:
        verdicts = self.navigator.verdicts
        while verdicts:
            verdict = verdicts.popleft()
            if not verdict.measurement.aiding:
                continue
            self.navigator.heed(verdict)
            if verdict.accepted:
                self.fixes_fused += 1
                self._fused_ns = verdict.measurement.t_ns
                if verdict.inflated:
                    self.counts["gnss: state opened"] += 1
                    self._log("warn", f"gnss: {verdict.reason}")
            else:
                self.counts[f"gnss: {verdict.reason}"] += 1
            offset = self._offsets.pop(
                (verdict.measurement.kind, verdict.measurement.t_ns), self._gnss.time_offset
            )
            self.outbox.append(
                ("gnss/verdict", cdr.encode_status(conversions.verdict_status(verdict, offset)))
            )

    def tick(self) -> None:
        """Do what is not done with every sample; the owner calls it after each, once published."""
        t_ns = self.navigator.last_ns
        if t_ns < self._tick_ns and not self.navigator.verdicts:
            return
        self._tell_verdicts()
        if self._reader is not None and t_ns >= self._refresh_ns:
            self._refresh_ns = t_ns + int(self.values["noise.refresh_period"] * 1e9)
            self.navigator.change_noise(self._reader.read(self.navigator.ring, t_ns))
        if t_ns >= self._report_ns:
            self._report_ns = t_ns + REPORT_NS
            self._look()
            self.navigator.find_clock()
            self._report(t_ns)
        self._tick_ns = self._report_ns
        if self._reader is not None:
            self._tick_ns = min(self._tick_ns, self._refresh_ns)

    def _look(self) -> None:
        """Let the navigator look at the IMU's health, and tell what it finds."""
        before = self.navigator.fault
        self.navigator.look()
        fault = self.navigator.fault
        if fault is not None and fault != before:
            self.remark("imu/data", Refused(*fault))

    def _report(self, t_ns: int) -> None:
        """Say what is said ten times a second; position is known before the heading is."""
        running = self.navigator.best
        if running is not None:
            if not self._aligned and self.navigator.filter is not None:
                self._aligned = self.ever_aligned = True
                sigma = math.degrees(math.sqrt(running.nav[COVARIANCE][DIAGONAL][8]))
                self._log("info", f"aligned: heading known to {sigma:.1f}°")
            output.fix_values(running.nav, self._arm_b, self._filtered_fix.values)
            self.outbox.append(("gnss/filtered", self._filtered_fix.message(t_ns)))
            output.bias_values(running.nav, self._biases.values)
            self.outbox.append(("imu/bias", self._biases.message(t_ns)))
            levels = running.noise.levels()
            for topic, q in (("q/accelerometer", levels[:3]), ("q/gyroscope", levels[3:])):
                self._variances.values[:] = q
                self.outbox.append((topic, self._variances.message(t_ns)))
        if t_ns >= self._diagnostics_ns:
            self._diagnostics_ns = t_ns + DIAGNOSTICS_NS
            self.outbox.append(
                ("/diagnostics", cdr.encode_diagnostics(t_ns, self.diagnostics(t_ns)))
            )

    def diagnostics(self, t_ns: int) -> list[Status]:
        """Say how the filter is at ``t_ns`` [ns]."""
        return [
            self._filter_status(t_ns),
            self._input_status(),
            self._noise_status(),
            self._clock_status(),
        ]

    def _filter_status(self, t_ns: int) -> Status:
        running = self.navigator.filter
        if running is None:
            state, waiting = WAITING[self.navigator.state], self.navigator.waiting_for
            values: dict[str, object] = {"state": state, "waiting_for": waiting}
            if self.navigator.bank is not None:
                heading_std = self.navigator.bank.heading()[1]
                values["sigma_heading_deg"] = min(math.degrees(heading_std), 104.0)
                values["hypotheses"] = len(self.navigator.bank.filters)
            return conversions.status("filter", 1, f"aligning, {state}: it needs {waiting}", values)
        since = (t_ns - max(self._fused_ns, 1)) * 1e-9 if self._fused_ns else math.inf
        sigma = np.sqrt(running.nav[COVARIANCE][DIAGONAL])
        outage = since > DEAD_RECKONING_AFTER
        text = (
            f"dead reckoning for {since:.0f} s, position σ {max(sigma[:2]):.1f} m"
            if outage
            else "aligned, GNSS fused"
        )
        return conversions.status(
            "filter",
            int(outage),
            text,
            {
                "state": "dead reckoning" if outage else "aligned",
                "since_last_fix": since,
                "sigma_position_horizontal": float(math.hypot(*sigma[:2])),
                "sigma_position_vertical": float(sigma[2]),
                "sigma_heading_deg": math.degrees(sigma[8]),
                "fixes_fused": self.fixes_fused,
                "standing": str(self.navigator.standing).lower(),
                "imu_samples": self.navigator.ring.count,
            },
        )

    def _input_status(self) -> Status:
        fault = self.navigator.fault
        if fault is not None:
            return conversions.status(
                "input", 2, f"{fault[0]}: {fault[1]}", dict(sorted(self.counts.items()))
            )
        refused = sum(self.counts.values())
        text = "all input used" if refused == 0 else f"{refused} messages refused or remarkable"
        return conversions.status(
            "input", int(refused > 0), text, dict(sorted(self.counts.items()))
        )

    def _noise_status(self) -> Status:
        running = self.navigator.filter
        source = _source(running.noise) if running else "none"
        reader = self._reader
        if source == "learned" and reader is not None:
            source = f"learned ({reader.regressor.name})"
        levels = running.noise.levels() if running else np.full(6, np.nan)
        text = f"source: {source}"
        factors = _factors(running.noise) if running else {}
        if running is not None and _imu_disagrees(running.noise):
            text += (
                "; the IMU disagrees with GNSS by more than its noise: check clock offset, "
                "mount, lever arm"
            )
        if factors.get("factor_fixes", 1.0) > DISAGREEMENT:
            text += (
                "; fixes scatter by more than they claim: check the receiver, gnss.position_std_min"
            )
        if reader is not None and reader.fault and running is not None:
            text += f"; last estimate refused: {reader.fault}"
        level = int(source == "fallback" or max(factors.values(), default=1.0) > DISAGREEMENT)
        return conversions.status(
            "process noise",
            level,
            text,
            {
                "source": source,
                "mode": self.values["noise.mode"],
                **factors,
                **(
                    {f"refused: {why}": n for why, n in sorted(reader.refusals.items())}
                    if reader is not None
                    else {}
                ),
                **{
                    f"q_{channel}": float(value)
                    for channel, value in zip(
                        ("ax", "ay", "az", "gx", "gy", "gz"), levels, strict=True
                    )
                },
            },
        )

    def _clock_status(self) -> Status:
        found, offset = self._clock_found(), self._gnss.time_offset
        values: dict[str, object] = {
            "time_offset": offset,
            "estimated": str(self.values["gnss.time_offset.estimate"]).lower(),
        }
        if found is None:
            return conversions.status("clock", 0, f"fixes: {offset:+.3f} s, as given", values)
        missing, sigma = found
        values |= {"time_offset_found": offset + missing, "sigma": sigma}
        fault = self._clock_fault()
        searching = ", the search goes on" if self.navigator.clock_open else ""
        text = fault or (
            f"fixes: {offset:+.3f} s in force, by the innovations "
            f"{offset + missing:+.3f} ± {sigma:.3f} s{searching}"
        )
        return conversions.status("clock", int(bool(fault)), text, values)

    def summary(self) -> str:
        """Return a line on what was fused and what was not."""
        refused = ", ".join(f"{name} ×{n}" for name, n in sorted(self.counts.items()))
        return f"{self.fixes_fused} fixes fused" + (f"; {refused}" if refused else "")


def _source(noise: FilterNoise) -> str:
    """Return where the variances in force come from."""
    if isinstance(noise.model, LearnedNoise):
        return "fallback" if noise.model.on_fallback else "learned"
    return "innovation" if isinstance(noise.model, InnovationNoise) else "constant"


def _imu_disagrees(noise: FilterNoise) -> bool:
    """Tell whether the fixes ask for much more noise of the IMU than it shows."""
    return max(noise.imu_factors) > DISAGREEMENT


def _factors(noise: FilterNoise) -> dict[str, float]:
    """What the innovations multiply the noise by; empty where they do not."""
    if noise.factors is None:
        return {}
    accelerometer, gyroscope = noise.imu_factors
    return {
        "factor_accelerometer": accelerometer,
        "factor_gyroscope": gyroscope,
        "factor_fixes": noise.fix_factor,
    }


def warm_up(new_message: NewMessage) -> None:
    """Go once through everything that runs at the IMU's rate; see also `kernels.prepare`."""
    values = {
        **parameters.defaults(),
        "alignment.heading_source": "parameter",
        "alignment.window": 0.05,
    }
    estimator = Estimator(values, lambda level, text: None)
    fix = new_message("sensor_msgs/msg/NavSatFix")
    fix.status.status = conversions.STATUS_FIX
    fix.latitude = 1.0
    velocity = new_message("geometry_msgs/msg/TwistWithCovarianceStamped")
    for k in range(1, 101):
        t_ns = k * 10_000_000
        estimator.imu(t_ns, (0.0, 0.0, 9.8), (0.0, 0.0, 0.0))
        estimator.tick()
        if k % 20 == 0:
            for message in (fix, velocity):
                conversions.set_stamp(message.header.stamp, t_ns)
            estimator.fix(fix)
            estimator.velocity(velocity)
    stamps = 1_000_000_000 + 10_000_000 * np.arange(1, 6)
    estimator.imu_block(stamps, np.tile([0.0, 0.0, 9.8], (5, 1)), np.zeros((5, 3)))
    if not estimator.ever_aligned:
        raise RuntimeError("the warm-up run did not reach the filter")
