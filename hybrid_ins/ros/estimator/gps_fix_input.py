"""
GPSFix messages into an estimator.
"""

from __future__ import annotations

from typing import Any

from hybrid_ins.ros.estimator.estimator import Estimator
from hybrid_ins.ros.messages.conversions import NewMessage, time_of
from hybrid_ins.ros.messages.gps_fix import (
    TrackCheck,
    fix_type,
    position_of,
    velocity_of,
)

Message = Any

ABSENT = "gps_msgs is not installed: there is no subscription gnss/gpsfix"
OTHER_TOPIC_NS = 5_000_000_000  # after which gnss/fix is silent


class GpsFixInput:
    """
    Gives GPSFix messages to an estimator: as NavSatFix, and as velocity.

    Parameters
    ----------
    estimator : Estimator
    new : callable
        Given the name of a type, returns an empty message of it.
    """

    def __init__(self, estimator: Estimator, new: NewMessage) -> None:
        self._estimator = estimator
        self._new = new
        self._track = TrackCheck()
        self._fix_type = ""
        self._other_ns: int | None = None  # stamp of the last NavSatFix

    def note_fix(self, message: Message, received_ns: int | None = None) -> None:
        """Note a NavSatFix on gnss/fix: it goes before a GPSFix, unless it has no stamp."""
        self._other_ns = time_of(message, received_ns) or self._other_ns

    def handle(self, message: Message, received_ns: int | None = None) -> list[Message]:
        """Use a message; returns what was made of it: a NavSatFix, a velocity."""
        estimator, inputs = self._estimator, self._estimator.inputs
        t_ns = time_of(message, received_ns)
        if self._other_ns is not None and abs(t_ns - self._other_ns) < OTHER_TOPIC_NS:
            inputs.warn_once(
                "gnss: two topics of fixes",
                "gnss/fix and gnss/gpsfix both have messages: gnss/gpsfix is not used; remap one",
            )
            return []
        used = [position_of(message, self._new)]
        estimator.handle_fix(used[0], received_ns)
        self._note_receiver(message)
        velocity = velocity_of(message, self._new)
        if velocity is not None:
            self._track.observe(t_ns, message)
        if self._track.contradicted:
            inputs.note(
                "gnss: track",
                f"gnss/gpsfix: track {message.track:.2f} is {self._track.contradicted}, while the "
                "message asks for degrees clockwise from north: velocities are not used; correct "
                "the driver",
            )
        elif velocity is not None and self._track.confirmed:
            estimator.handle_velocity(velocity, received_ns)
            used.append(velocity)
        return used

    def _note_receiver(self, message: Message) -> None:
        """Keep for diagnostics what a NavSatFix does not have."""
        inputs, found = self._estimator.inputs, fix_type(int(message.status.status))
        if self._fix_type and found != self._fix_type:
            inputs.inform(f"gnss: {found}", f"gnss/gpsfix: {self._fix_type} -> {found}")
        self._fix_type = inputs.receiver["fix_type"] = found
        inputs.receiver["satellites_used"] = int(message.status.satellites_used)
        for name in ("hdop", "vdop"):
            value = float(getattr(message, name))
            if value > 0.0:
                inputs.receiver[name] = value
