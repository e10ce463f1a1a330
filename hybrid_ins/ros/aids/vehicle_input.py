"""
The constraint of a vehicle on wheels, or with wings, into the navigator.

It is used where fixes are missing, that of wheels also where they do not show the heading: on a
straight road at a steady speed nothing but the nose does.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.constraints.constraint_observer import ConstraintObserver, ConstraintSettings
from hybrid_ins.core.constraints.near_standstill import WINDOW_NS, NearStandstillDetector
from hybrid_ins.core.constraints.nonholonomic import Nose
from hybrid_ins.core.constraints.sideslip import WindObserver
from hybrid_ins.core.filter.ins_filter import InsFilter, sensitivity_to_scale
from hybrid_ins.core.inertial.state import HEADING_VARIANCE, VELOCITY
from hybrid_ins.core.navigator.fix_watch import FixWatch
from hybrid_ins.core.navigator.navigator import Navigator
from hybrid_ins.noise_regressor.slip import SlipReader
from hybrid_ins.ros.messages.conversions import FLIP
from hybrid_ins.ros.reporting.diagnostics import status
from hybrid_ins.ros.reporting.input_log import Log
from hybrid_ins.ros.reporting.reports import Status

Array = NDArray[np.float64]

PERIOD_NS = 500_000_000  # between two observations
RATE_NS = 60_000_000  # of samples whose mean is the angular rate
CONSTRAINED = ("auto", "ground")  # values of vehicle.kind
LEAST_HEADING_STD = math.radians(3.0)  # from which on the nose says more than fixes do
NOSE_STDS = 2.0  # σ of the nose's yaw, likewise: the heading becomes no more certain than that
SLOWEST = 0.5  # m/s: a nose that moves more slowly shows no heading
OWN_NS = 60_000_000_000  # after that use: what the motion then shows of the nose was assumed


class VehicleInput:
    """
    Observes whether the vehicle moves along its nose, and constrains the filter in outages.

    A fixed wing moves along its nose against the air: the wind is observed.

    Fixes alone determine the motion while they come and show the heading: what they show of the
    vehicle is free of what is assumed about it.

    Parameters
    ----------
    values : mapping
        Checked parameters.
    navigator : Navigator
    fixes : FixWatch
    log : callable
        Called with a level (info, warn, error) and a line for the user.

    Attributes
    ----------
    observer : ConstraintObserver or None
        None where ``vehicle.kind`` excludes the constraint of wheels.
    wind : WindObserver or None
        None where ``vehicle.kind`` is not ``fixed_wing``.
    fused : bool
        The constraint was fused at the last observation.
    slip : SlipReader
        What the samples show of the constraint's covariance.
    stands : NearStandstillDetector
        Whether the samples are those of a stand with the engine on.
    near_standstill : bool
        They were at the last observation, in an outage.
    """

    def __init__(
        self,
        values: Mapping[str, Any],
        navigator: Navigator,
        fixes: FixWatch,
        log: Log,
    ) -> None:
        self._values = values
        self._navigator = navigator
        self._fixes = fixes
        self._log = log
        self.observer: ConstraintObserver | None = None
        self.wind: WindObserver | None = None

    def configure(self, mount: Array, arm_b: Array) -> None:
        """
        Begin anew.

        Parameters
        ----------
        mount : ndarray, shape (3, 3)
            From the IMU's axes to b.
        arm_b : ndarray, shape (3,)
            Place of the IMU relative to the base frame's origin [m], b.
        """
        values = self._values
        slip_std = np.array(values["vehicle.slip_std"])
        self.slip = SlipReader(values["vehicle.slip_model"], slip_std, mount, self._log)
        self.stands = NearStandstillDetector()
        self.restart()
        yaw, pitch = values["vehicle.nose"]
        if values["vehicle.kind"] == "fixed_wing":
            self.wind = WindObserver(Nose(-yaw, pitch, np.zeros(3)))
        if values["vehicle.kind"] not in CONSTRAINED:
            return
        point_b = FLIP @ np.array(values["vehicle.axle_position"]) - arm_b
        self.observer = ConstraintObserver(
            ConstraintSettings(
                Nose(-yaw, pitch, point_b),
                values["vehicle.nose_std"],
                values["vehicle.axle_position_std"],
                slip_std,
                values["vehicle.kind"] == "ground",
            )
        )
        if self.observer.holds:
            self.slip.prepare()

    def restart(self) -> None:
        """Restart, as the filter did; the vehicle is the same."""
        self._next_ns = self._own_until_ns = 0
        self.fused = self.near_standstill = self._in_outage = False
        self.stands.restart()

    def run_periodic(self, t_ns: int) -> None:
        """Observe the motion at a stamp [ns], and constrain it, where that is due."""
        if (self.observer is None and self.wind is None) or t_ns < self._next_ns:
            return
        self._next_ns = t_ns + PERIOD_NS
        running = self._navigator.filter
        self.fused = self.near_standstill = False
        if running is None or self._navigator.monitor.standing or not self._fixes.started:
            return
        if self.wind is not None:
            self._observe_wind(self.wind, running.flat_state(), t_ns)
        else:
            self._observe(running, t_ns)

    def _observe_wind(self, wind: WindObserver, nav: Array, t_ns: int) -> None:
        wind.observe(t_ns, nav, PERIOD_NS * 1e-9, settled=self._fixes.settled(t_ns))
        if self._fixes.outage(t_ns):
            constraint = wind.measurement(t_ns, nav, PERIOD_NS * 1e-9)
            self.fused = constraint is not None
            if constraint is not None:
                self._navigator.measure(constraint)

    def _observe(self, running: InsFilter, t_ns: int) -> None:
        observer = self.observer
        assert observer is not None
        nav = running.flat_state()
        samples = self._navigator.ring.after(t_ns - WINDOW_NS)
        rate_b = samples["w"][samples["t_ns"] > t_ns - RATE_NS].mean(axis=0)
        held = observer.holds
        settled = self._fixes.settled(t_ns) and t_ns > self._own_until_ns
        answer = None
        if held:
            self.slip.read(self._navigator.ring, observer.nose, t_ns)
            answer = self.slip.covariance if self.slip.answers else None
        observer.observe(
            nav,
            rate_b,
            PERIOD_NS * 1e-9,
            fused=not settled,
            answer=answer,
            by_scale=sensitivity_to_scale(running) if settled else None,
        )
        if observer.holds != held:
            self._log_change()
        self._in_outage = self._fixes.outage(t_ns)
        needed = self._in_outage or _heading_is_uncertain(nav, observer)
        self.fused = needed and held and observer.holds
        if settled:
            self.stands.learn(samples, nav, PERIOD_NS * 1e-9, observer.nose)
        if self.fused:
            slip = self._slip_covariance(observer)
            self._navigator.measure(observer.measurement(t_ns, nav, rate_b, PERIOD_NS * 1e-9, slip))
            if not self._in_outage:
                self._own_until_ns = t_ns + OWN_NS
                return
            stand = self.stands.measurement(samples, nav, rate_b, observer.nose)
            self.near_standstill = stand is not None
            if stand is not None:
                self._navigator.measure(stand)

    def _slip_covariance(self, observer: ConstraintObserver) -> Array:
        """Return the model's answer, scaled as the motion has shown; without one the nominal."""
        scale = observer.ratio.covariance if self.slip.answers else 1.0
        return np.asarray(self.slip.covariance * scale)

    def _log_change(self) -> None:
        observer = self.observer
        assert observer is not None
        if observer.holds:
            self.slip.prepare()
            self._log(
                "info",
                f"vehicle: it moves along its nose ({_nose(observer)}): this constrains the "
                "velocity in outages",
            )
        else:
            self._log(
                "warn",
                "vehicle: it moves across its nose: the constraint is off until the motion shows "
                "it again",
            )

    def status(self) -> Status:
        """Return the status on ``/diagnostics``."""
        kind, observer = self._values["vehicle.kind"], self.observer
        if self.wind is not None:
            return _wind_status(self.wind, self.fused)
        if observer is None:
            return status("vehicle", 0, f"{kind}: no constraint", {"kind": kind})
        if self.fused:
            why = "outage" if self._in_outage else "fixes do not show the heading"
            text = f"{why}: the velocity is constrained to the nose, slip: {self.slip.source}"
            if self.near_standstill:
                text += "; it stands or crawls"
            if self.slip.fault:
                text += f"; last window refused: {self.slip.fault}"
        elif observer.holds:
            text = "moves along its nose"
        else:
            text = "no motion along the nose shown"
        yaw_std, pitch_std, along_std, squat_std = observer.sigma.tolist()
        along = float(observer.nose.forward @ observer.nose.point_b)
        left_std, up_std = np.sqrt(np.diag(observer.slip.covariance)).tolist()
        used_left, used_up = np.sqrt(np.diag(self._slip_covariance(observer))).tolist()
        return status(
            "vehicle",
            0,
            text,
            {
                "kind": kind,
                "constraint": "fused" if self.fused else "holds" if observer.holds else "off",
                "stands_recognised": self.stands.distinguishes,
                "evidence": observer.evidence,
                "evidence_recent": observer.recent,
                "nose_yaw_deg": -math.degrees(observer.nose.yaw),
                "nose_yaw_std_deg": math.degrees(yaw_std),
                "nose_pitch_deg": math.degrees(observer.nose.pitch),
                "nose_pitch_std_deg": math.degrees(pitch_std),
                "axle_ahead_of_imu": along,
                "axle_std": along_std,
                "squat": observer.nose.squat,
                "squat_std": squat_std,
                "slip_std_left": left_std,
                "slip_std_up": up_std,
                "slip_source": self.slip.source,
                "slip_std_left_used": used_left,
                "slip_std_up_used": used_up,
                **{f"refused: {why}": n for why, n in sorted(self.slip.refusals.items())},
            },
        )


def _wind_status(wind: WindObserver, fused: bool) -> Status:
    """Return the status of a fixed wing."""
    text = "outage: no sideslip in the wind" if fused else "the wind is observed"
    north_std, east_std = wind.sigma.tolist()
    return status(
        "vehicle",
        0,
        text,
        {
            "kind": "fixed_wing",
            "constraint": "fused" if fused else "holds",
            "wind_north": float(wind.wind_n[0]),
            "wind_north_std": north_std,
            "wind_east": float(wind.wind_n[1]),
            "wind_east_std": east_std,
            "sideslip_std": float(np.sqrt(wind.slip.covariance[0, 0])),
        },
    )


def _heading_is_uncertain(nav: Array, observer: ConstraintObserver) -> bool:
    """Return whether the nose of a vehicle that moves says more of the heading than fixes do."""
    known = max(LEAST_HEADING_STD, NOSE_STDS * float(observer.sigma[0]))
    moves = float(np.linalg.norm(nav[VELOCITY][:2])) > SLOWEST
    return moves and nav.item(HEADING_VARIANCE) > known**2


def _nose(observer: ConstraintObserver) -> str:
    """Return the nose's direction as text."""
    yaw, pitch = -math.degrees(observer.nose.yaw), math.degrees(observer.nose.pitch)
    sigma = math.degrees(max(observer.sigma[:2]))
    return f"yaw {yaw:+.1f}°, pitch {pitch:+.1f}°, each ± {sigma:.1f}° in base_frame"
