"""
Sensors besides GNSS into the navigator: velocity in the vehicle, heading, pressure height.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.aiding.life_cycle import AidingSensor, AidingState
from hybrid_ins.core.aiding.measurements import BodyVelocity
from hybrid_ins.core.aiding.sensors import HeadingSensor, HeightSensor, VelocitySensor
from hybrid_ins.core.aiding.unaided import UnaidedState
from hybrid_ins.core.filter.events import StateRestored
from hybrid_ins.core.filter.ins_filter import TOO_OLD, InsFilter
from hybrid_ins.core.navigator.fix_watch import FixWatch
from hybrid_ins.core.navigator.navigator import Navigator
from hybrid_ins.core.navigator.stamp_check import STAMPED_AHEAD
from hybrid_ins.core.update.measurements import Measurement
from hybrid_ins.ros.messages.aiding_conversions import AidingMessages, substituted
from hybrid_ins.ros.messages.conversions import FLIP, Message, Refused
from hybrid_ins.ros.messages.interface import AIDING
from hybrid_ins.ros.reporting.diagnostics import status
from hybrid_ins.ros.reporting.input_log import InputLog
from hybrid_ins.ros.reporting.reports import Status

Array = NDArray[np.float64]

TOPICS = {topic.name: topic.type_name for topic in AIDING}
QUIET_NS = 100_000_000_000  # after a change of a sensor's state was logged: it may flap
AHEAD_KEPT = 64  # readings that wait for the IMU
STATES_KEPT = 12  # states, one with each tenth of a second: readings may be a second late
OLDEST_NS = 1_200_000_000  # late readings are refused from here on
PRESENT_NS = 30_000_000  # readings of that age are compared with the present state
EXCESSIVE, BOUNDED = 16.0, 8.0  # factors on a claimed variance that are logged, that end it
REMEDIES = {
    "velocity": "check aiding.velocity_scale, aiding.velocity_position and the axes",
    "heading": "check the sensor's mount and what is magnetic near it",
    "baro": "check the unit, Pa, and the sensor's ventilation",
}

STD_PARAMETERS = {
    "velocity": "aiding.velocity_std_min",
    "heading": "aiding.heading_std_min",
    "baro": "aiding.height_std_min",
}


class AidingSources:
    """
    Checks and uses the messages of aiding sensors.

    Parameters
    ----------
    values : mapping
        Checked parameters.
    navigator : Navigator
    fixes : FixWatch
    inputs : InputLog
    """

    def __init__(
        self, values: Mapping[str, Any], navigator: Navigator, fixes: FixWatch, inputs: InputLog
    ) -> None:
        self._values = values
        self._navigator = navigator
        self._fixes = fixes
        self._inputs = inputs
        # Stamps [ns], flat states, and in outages those that nothing has aided for some seconds.
        self._states: deque[tuple[int, Array, Array | None]] = deque(maxlen=STATES_KEPT)
        self._unaided = UnaidedState()
        self._ahead: deque[tuple[str, AidingSensor, Measurement]] = deque(maxlen=AHEAD_KEPT)

    def configure(self, arm_b: Array) -> None:
        """Begin anew with the IMU at a place (3,) relative to the base frame's origin [m], b."""
        values = self._values
        self._messages = AidingMessages.from_parameters(values, arm_b)
        self._velocity = VelocitySensor(
            values["aiding.velocity_scale"],
            values["aiding.velocity_scale_std"],
            np.broadcast_to(values["aiding.velocity_position_std"], 3),
        )
        self._heading, self._height = HeadingSensor(), HeightSensor()
        self._logged: dict[str, AidingState] = {}
        self._quiet_until_ns: dict[tuple[str, AidingState], int] = {}
        self._excessive: set[str] = set()  # names of sensors
        self.restart()

    def restart(self) -> None:
        """Restart, as the filter did; the sensors are the same."""
        for sensor in (self._velocity, self._heading, self._height):
            sensor.restart()
        self._states.clear()
        self._unaided.restart()
        self._ahead.clear()
        self._quiet_until_ns.clear()

    def handle(self, topic: str, message: Message, received_ns: int | None = None) -> None:
        """Use a message of one of the ``TOPICS``; ``received_ns`` replaces its stamp if given."""
        messages = self._messages
        sensor: AidingSensor
        convert: Callable[[Message, int | None], Measurement | Refused]
        sensor, convert = {
            "aiding/velocity": (self._velocity, messages.twist),
            "aiding/odometry": (self._velocity, messages.odometry),
            "aiding/heading": (self._heading, messages.heading),
            "aiding/pressure": (self._height, messages.pressure),
        }[topic]
        reading = convert(message, received_ns)
        if isinstance(reading, BodyVelocity):
            text = substituted(message, messages.velocity_std_min)
            if text:
                self._inputs.note(f"{topic}: covariance", f"{topic}: {text}")
        self._use(topic, sensor, reading)

    def _use(self, topic: str, sensor: AidingSensor, reading: Measurement | Refused) -> None:
        if isinstance(reading, Refused):
            self._inputs.count_and_warn(topic, reading)
            return
        running = self._navigator.filter
        if running is None:
            return
        fault = self._stamp_fault(reading.t_ns, running)
        if fault:
            text = _describe_stamp((reading.t_ns - running.t_ns) * 1e-9)
            self._inputs.count_and_warn(topic, Refused(f"{sensor.name}: {fault}", text))
            return
        if reading.t_ns > running.t_ns + PRESENT_NS:
            self._ahead.append((topic, sensor, reading))
            return
        if self._precedes_states(reading.t_ns) or not sensor.admit(reading.t_ns):
            return
        now_ns = self._navigator.last_ns
        nav, unaided = self._states_at(reading.t_ns, running)
        fixes_come, outage = self._fixes.settled(now_ns), self._fixes.outage(now_ns)
        measurement = sensor.check(reading, nav, checked=fixes_come, outage=outage, unaided=unaided)
        self._log_change(sensor)
        if measurement is not None:
            self._navigator.measure(measurement)
        if sensor.took_along:
            sensor.took_along = False
            self._restore(running)

    def _stamp_fault(self, t_ns: int, running: InsFilter) -> str:
        """Return why there is no state to check a reading with a stamp [ns] against, if so."""
        if self._navigator.stamps.is_ahead(t_ns):
            return STAMPED_AHEAD
        return TOO_OLD if t_ns < running.t_ns - OLDEST_NS else ""

    def _precedes_states(self, t_ns: int) -> bool:
        """Return whether a stamp [ns] is before the states that are kept since a sensor came."""
        return bool(self._states) and t_ns < self._states[0][0] - 60_000_000

    def _states_at(self, t_ns: int, running: InsFilter) -> tuple[Array, Array | None]:
        """Return the flat state nearest to a stamp [ns], and that which nothing has aided."""
        if t_ns > running.t_ns - PRESENT_NS or not self._states:
            nav = running.flat_state()
            return nav, self._follow_unaided(nav, running)
        return min(self._states, key=lambda kept: abs(kept[0] - t_ns))[1:]

    def _follow_unaided(self, nav: Array, running: InsFilter) -> Array | None:
        """Return what the filter's present flat state would be unaided; None while fixes come."""
        if not self._fixes.outage(running.t_ns):
            self._unaided.restart()
            return None
        return self._unaided.follow(nav, running.t_ns, running.ring, running.covariance_interval)

    def _restore(self, running: InsFilter) -> None:
        """Undo what a sensor that took the filter along has done to it."""
        unaided = self._follow_unaided(running.flat_state(), running)
        if unaided is not None:
            since_ns = self._unaided.since_ns
            running.submit(StateRestored(running.t_ns, unaided, since_ns))
            self._states.clear()

    def run_periodic(self, t_ns: int) -> None:
        """Keep the state at a stamp [ns], and use readings that waited; some times a second."""
        running = self._navigator.filter
        heard = (self._velocity, self._heading, self._height)
        is_heard = any(sensor.state(t_ns) is not AidingState.ABSENT for sensor in heard)
        if running is None or not (is_heard or self._ahead):
            return
        nav = running.flat_state()
        self._states.append((t_ns, nav, self._follow_unaided(nav, running)))
        for _ in range(len(self._ahead)):
            self._use(*self._ahead.popleft())
        for sensor in heard:
            self._log_change(sensor)

    # For the user.

    def _log_change(self, sensor: AidingSensor) -> None:
        """Log a change of a sensor's state, and errors beyond what it claims."""
        self._log_excess(sensor)
        state = sensor.state(self._navigator.last_ns)
        before = self._logged.get(sensor.name)
        if state is before or state is AidingState.ABSENT:
            return
        self._logged[sensor.name] = state
        change, now_ns = (sensor.name, state), self._navigator.last_ns
        if now_ns < self._quiet_until_ns.get(change, 0):
            return
        self._quiet_until_ns[change] = now_ns + QUIET_NS
        if state is AidingState.REFUSED:
            self._inputs.log(
                "warn",
                f"aiding: {sensor.name} disagrees with the motion (NIS {sensor.nis:.0f} per "
                f"component): it is not used; {REMEDIES[sensor.name]}",
            )
        elif state is AidingState.FROZEN:
            self._inputs.log(
                "warn",
                f"aiding: {sensor.name} repeats one reading while the vehicle moves: it is not "
                "used until it changes; check the sensor and its driver",
            )
        elif state is AidingState.LOST:
            self._inputs.log("warn", f"aiding: {sensor.name}: no message of use for 2 s")
        elif state is AidingState.AIDING:
            self._inputs.log("info", f"aiding: {sensor.name} agrees with the motion: it is used")

    def _log_excess(self, sensor: AidingSensor) -> None:
        factor = sensor.factor
        if factor < BOUNDED:
            self._excessive.discard(sensor.name)
        elif factor > EXCESSIVE and sensor.name not in self._excessive:
            self._excessive.add(sensor.name)
            self._inputs.log(
                "warn",
                f"aiding: {sensor.name} errs by more than it claims, or for longer: its variance "
                f"counts {factor:.0f}-fold; {REMEDIES[sensor.name]}, or raise "
                f"{STD_PARAMETERS[sensor.name]}",
            )

    def status(self, t_ns: int) -> Status:
        """Return the status on ``/diagnostics`` at a stamp [ns]."""
        values: dict[str, object] = {}
        level, parts = 0, []
        for sensor in (self._velocity, self._heading, self._height):
            state = sensor.state(t_ns)
            values[sensor.name] = state.value
            if state is AidingState.ABSENT:
                continue
            parts.append(f"{sensor.name} {state.value}")
            values[f"{sensor.name}_nis"] = sensor.nis
            values[f"{sensor.name}_factor"] = sensor.factor
            if state in (AidingState.REFUSED, AidingState.FROZEN, AidingState.LOST):
                level = 1
        sigma = self._velocity.sigma
        values["velocity_scale"] = self._velocity.scale
        values["velocity_scale_std"] = float(sigma[0])
        place = np.array(self._values["aiding.velocity_position"]) + FLIP @ self._velocity.shift_b
        for axis, along, std in zip("xyz", place.tolist(), sigma[1:].tolist(), strict=True):
            values[f"velocity_position_{axis}"] = along
            values[f"velocity_position_{axis}_std"] = std
        if math.isfinite(self._height.offset_std):
            values["baro_offset"] = self._height.offset
            values["baro_offset_std"] = self._height.offset_std
        return status("aiding", level, ", ".join(parts) or "no sensors besides GNSS", values)


def _describe_stamp(ahead: float) -> str:
    """Return that a stamp is so far ahead of the IMU's [s], and the remedy."""
    if ahead > 0.0:
        return f"header.stamp is {ahead:.1f} s ahead of the IMU's: let both stamp by one clock"
    return f"header.stamp is {-ahead:.1f} s behind the IMU's: let both stamp by one clock"
