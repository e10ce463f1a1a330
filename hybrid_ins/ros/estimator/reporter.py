"""
What the estimator reports: verdicts as they come, the state ten times a second, diagnostics.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.filter.gap import LONG_GAP
from hybrid_ins.core.filter.ins_filter import TOO_OLD
from hybrid_ins.core.fix_checks.frozen_height import FrozenHeight
from hybrid_ins.core.fix_checks.velocity_check import Contradiction
from hybrid_ins.core.inertial.state import DV, QUAT, VELOCITY, total_std
from hybrid_ins.core.navigator.navigator import Navigator
from hybrid_ins.core.navigator.notices import (
    FaultFound,
    GapBridged,
    HeadingCorrected,
    HeadingOutdated,
    Notice,
    Restarted,
    TurnedOnTheSpot,
)
from hybrid_ins.core.navigator.stamp_check import PUBLISHED_AGAIN, STAMPED_AHEAD
from hybrid_ins.core.update.gate import Verdict
from hybrid_ins.core.update.measurements import GNSS
from hybrid_ins.ros.messages.conversions import KNOWN, Refused
from hybrid_ins.ros.output import output
from hybrid_ins.ros.output.odometry import OdometrySource
from hybrid_ins.ros.output.rate_limiter import RateLimiter
from hybrid_ins.ros.reporting import diagnostics, wording
from hybrid_ins.ros.reporting.clocks import describe_wrong_stamp
from hybrid_ins.ros.reporting.input_log import InputLog, is_logged
from hybrid_ins.ros.reporting.reports import (
    Diagnostics,
    ImuBiases,
    MapOdometry,
    Position,
    Report,
    Status,
    Vector,
)

Array = NDArray[np.float64]

DIAGNOSTICS_NS = 1_000_000_000  # between two diagnostics messages
RESTARTS_LOGGED = 10  # of one cause, before only each tenfold number is logged
MISSTAMPED_FIXES = 10  # of which the first is logged: a start makes some
NOT_UNIT = 1e-3  # of a quaternion: rates turned it too far for one step
UNKNOWN = 0  # covariance type of a NavSatFix


class Reporter:
    """
    Collects reports, and logs what the user should know.

    Parameters
    ----------
    values : mapping
        The parameters in force: they may change.
    navigator : Navigator
    inputs : InputLog
    odometry : OdometrySource

    Attributes
    ----------
    fixes_fused : int
        Measurements that the filter fused.
    fused_ns : int
        Stamp of the last of them, or of the alignment [ns]; 0 after a restart.
    ever_located, ever_aligned : bool
        There was odometry at some time; the heading was known, too.
    """

    def __init__(
        self,
        values: Mapping[str, Any],
        navigator: Navigator,
        inputs: InputLog,
        odometry: OdometrySource,
    ) -> None:
        self._values = values
        self._base_frame, self._map_frame = values["base_frame"], values["map_frame"]
        self._navigator = navigator
        self._inputs = inputs
        self._odometry = odometry
        self._odometry_due = RateLimiter(values["odometry_rate"])
        self._reports: list[Report] = []
        self.fixes_fused = 0
        self.ever_located = self.ever_aligned = False
        self.restart()

    def restart(self) -> None:
        """Announce the filter again once it runs, and send diagnostics at once."""
        self._announced = False
        self._diagnostics_ns = self.fused_ns = 0
        self._imu_at_refusal_ns = 0  # stamp of the last sample when a fix was stamped wrongly

    def pop(self) -> Sequence[Report]:
        """Return what is to be published since the last call."""
        if not self._reports:
            return ()
        reports, self._reports = self._reports, []
        return reports

    def set_odometry_rate(self, rate: float) -> None:
        """Report odometry at another rate [Hz], while no single filter runs; 0: at every call."""
        self._odometry_due.change(rate)

    def add(self, reports: Sequence[Report]) -> None:
        """Publish reports of others, too."""
        self._reports += reports

    def on_notice(self, notice: Notice) -> None:
        """Count, log and report what happened to the navigator."""
        counts, log = self._inputs.counts, self._inputs.log
        if isinstance(notice, Verdict):
            self._on_verdict(notice)
        elif isinstance(notice, GapBridged):
            counts["imu: gaps bridged"] += 1
            if notice.seconds > LONG_GAP:
                text = wording.describe_gap(notice)
                self._inputs.count_and_warn("imu/data", Refused("imu: long gaps bridged", text))
        elif isinstance(notice, Restarted):
            name = f"restart: {notice.cause.value}"
            counts[name] += 1
            if counts[name] <= RESTARTS_LOGGED or is_logged(counts[name]):
                log("warn", f"{wording.describe_restart(notice)}: aligning anew")
        elif isinstance(notice, TurnedOnTheSpot):
            refused = Refused("gnss: turns on the spot", wording.TURNS_ON_THE_SPOT)
            self._inputs.count_and_warn("gnss/fix", refused)
        elif isinstance(notice, HeadingCorrected):
            counts["heading corrected"] += 1
            log("warn", wording.describe_correction(notice))
        elif isinstance(notice, HeadingOutdated):
            log("warn", wording.describe_outdated_heading(notice))
        elif isinstance(notice, Contradiction):
            text = wording.describe_contradiction(notice)
            log(
                "warn",
                f"gnss/velocity contradicts gnss/fix, and is not used until it agrees: {text}",
            )
        elif isinstance(notice, FrozenHeight):
            text = wording.describe_frozen_height(notice)
            self._inputs.count_and_warn("gnss/fix", Refused("gnss: altitude frozen", text))
        elif isinstance(notice, FaultFound):
            name, text = wording.name_of_fault(notice.fault), wording.describe_fault(notice.fault)
            self._inputs.count_and_warn("imu/data", Refused(name, text))

    def _on_verdict(self, verdict: Verdict) -> None:
        counts, sensor = self._inputs.counts, verdict.measurement.sensor
        if not verdict.accepted:
            counts[f"{sensor}: {verdict.reason}"] += 1
        if sensor != GNSS:  # only fixes end dead reckoning
            return
        if verdict.accepted:
            self.fixes_fused += 1
            self.fused_ns = verdict.measurement.t_ns
            if verdict.inflated:
                counts["gnss: state opened"] += 1
                self._inputs.log("warn", f"gnss: {verdict.reason}")
        elif verdict.reason in (TOO_OLD, STAMPED_AHEAD):
            count, imu_ns = counts[f"{sensor}: {verdict.reason}"], self._navigator.last_ns
            stopped, self._imu_at_refusal_ns = imu_ns == self._imu_at_refusal_ns, imu_ns
            is_due = count >= MISSTAMPED_FIXES and is_logged(count)
            if is_due and self._navigator.filter is not None:  # before, `FixRefusals` says it
                self._inputs.log("warn", describe_wrong_stamp(verdict.age, count, stopped))
        elif verdict.reason == PUBLISHED_AGAIN:
            count = counts[f"{sensor}: {PUBLISHED_AGAIN}"]
            if is_logged(count):
                self._inputs.log("warn", wording.describe_repetition(verdict, count))
        status = diagnostics.verdict_status(verdict)
        self._reports.append(Report("gnss/verdict", status, self._navigator.last_ns))

    def report_datum(self, t_ns: int, lla: Array) -> None:
        """Report the map's origin (rad, rad, m)."""
        latitude, longitude = np.degrees(lla[:2]).tolist()
        height, zero = float(lla[2]), np.zeros(9)
        datum = Position(t_ns, self._map_frame, latitude, longitude, height, zero, UNKNOWN)
        self._reports.append(Report("datum", datum, self._navigator.last_ns))

    def report_state(self, t_ns: int, arm_b: Array) -> None:
        """
        Report the state at a stamp [ns]; the position is known before velocity and heading are.

        ``arm_b``, shape (3,), is the IMU relative to the base frame's origin [m], b.
        """
        phase = self._navigator.phase
        best, nav = phase.best, phase.nav
        if nav is None:
            return
        if best is None:
            rate_variance = np.full(3, self._values["noise.q_gyroscope"])
            self._report_odometry(t_ns, nav, arm_b, rate_variance)
            return
        levels = best.noise.levels()
        if phase.filter is None:
            if not self._is_plausible(nav):
                return
            self._report_odometry(t_ns, nav, arm_b, levels[3:])
        elif not self._announced:
            self._announced = self.ever_located = self.ever_aligned = True
            self.fused_ns = self.fused_ns or t_ns
            sigma = math.degrees(total_std(nav)[8])
            self._inputs.log("info", f"aligned: heading known to {sigma:.1f}°")
        has_fix = (t_ns - self.fused_ns) * 1e-9 <= diagnostics.DEAD_RECKONING_AFTER
        self._reports += state_reports(t_ns, nav, levels, arm_b, self._base_frame, has_fix)

    def _is_plausible(self, nav: Array) -> bool:
        """Return whether the state of a search may be published: nobody has checked its IMU yet."""
        sigma = total_std(nav)
        fastest = max(float(np.abs(nav[VELOCITY]).max()), float(sigma[DV].max()))
        is_rotation = abs(float(nav[QUAT] @ nav[QUAT]) - 1.0) < NOT_UNIT
        is_reachable = fastest < self._values["gnss.max_speed"]
        return bool(np.isfinite(sigma).all()) and is_reachable and is_rotation

    def _report_odometry(self, t_ns: int, nav: Array, arm_b: Array, rate_variance: Array) -> None:
        """Report odometry while no single filter runs; `Estimator` returns that of one."""
        if self._odometry.map is None or not self._odometry_due.is_due(t_ns):
            return
        self.ever_located = True
        values = self._odometry.in_map(nav, arm_b, rate_variance)
        odometry = MapOdometry(t_ns, self._map_frame, self._base_frame, values)
        self._reports.append(Report("odometry", odometry, t_ns))

    def is_diagnostics_due(self, t_ns: int) -> bool:
        """Return whether to send diagnostics at a stamp [ns]."""
        return t_ns >= self._diagnostics_ns

    def report_diagnostics(self, t_ns: int, statuses: Sequence[Status]) -> None:
        """Report on ``/diagnostics``."""
        self._diagnostics_ns = t_ns + DIAGNOSTICS_NS
        self._reports.append(Report("/diagnostics", Diagnostics(t_ns, statuses), t_ns))


def state_reports(
    t_ns: int, nav: Array, levels: Array, arm_b: Array, frame: str, has_fix: bool = True
) -> list[Report]:
    """
    Return the reports on a state.

    Parameters
    ----------
    t_ns : int
        Stamp [ns].
    nav : ndarray, shape (N_NAV,) or longer
        Flat state of the IMU.
    levels : ndarray, shape (6,)
        Per-sample variances in force, b.
    arm_b : ndarray, shape (3,)
        IMU relative to the base frame's origin [m], b.
    frame : str
        The base frame's name.
    has_fix : bool
        A fix was fused not long ago.
    """
    fix, biases = np.empty(output.N_FIX), np.empty(output.N_BIAS)
    output.fix_values(nav, arm_b, fix)
    output.bias_values(nav, biases)
    latitude, longitude, height = fix[:3].tolist()
    position = Position(t_ns, frame, latitude, longitude, height, fix[3:], KNOWN, has_fix)
    return [
        Report("gnss/filtered", position, t_ns),
        Report("imu/bias", ImuBiases(t_ns, frame, biases[:3], biases[3:6], biases[6:]), t_ns),
        Report("q/accelerometer", Vector(t_ns, frame, levels[:3]), t_ns),
        Report("q/gyroscope", Vector(t_ns, frame, levels[3:]), t_ns),
    ]
