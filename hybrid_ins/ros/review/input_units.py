"""
Units, resolution and rates of the input that no single message shows to be wrong.
"""

from __future__ import annotations

import itertools
from collections import deque

from hybrid_ins.core.imu.samples import ImuRing, sample_period
from hybrid_ins.core.update.measurements import PositionFix
from hybrid_ins.ros.messages.conversions import Message, Refused, stamp_ns
from hybrid_ins.ros.reporting.input_log import InputLog

STAMPS_KEPT = 20  # fixes
SHARED = 8  # of them with the stamp of the one before, and another position
SECOND_NS = 1_000_000_000
RADIANS = 1.6, 3.2  # of latitude and longitude: in degrees that is open sea off Ghana
SIMULATED = 0.05  # deg: simulators start at zero, zero
HIGHEST = 20_000.0  # m: no vehicle with an IMU of this kind goes higher
SLOWEST = 25.0  # Hz, of an IMU
SHARE = 0.97  # of that: clocks differ
PERIOD_SAMPLES = 256  # that show the rate


class InputUnits:
    """
    Warns once of each, and keeps it for diagnostics.

    Parameters
    ----------
    inputs : InputLog
    """

    def __init__(self, inputs: InputLog) -> None:
        self._inputs = inputs
        self._stamps: deque[tuple[int, float, float]] = deque(maxlen=STAMPS_KEPT)

    def on_fix(self, message: Message, fix: PositionFix | Refused) -> None:
        """Compare a NavSatFix with those before."""
        if isinstance(fix, Refused):
            return
        self._stamps.append((stamp_ns(message.header.stamp), message.latitude, message.longitude))
        if abs(message.altitude) > HIGHEST:
            self._note(
                "gnss: unit of altitude",
                f"altitude is {message.altitude:.0f} m: it seems to be in millimetres or "
                "centimetres; let the driver publish metres above the ellipsoid",
            )
        if len(self._stamps) == STAMPS_KEPT:
            self._check_radians()
            self._check_whole_seconds()

    def _check_radians(self) -> None:
        if any(abs(lat) >= RADIANS[0] or abs(lon) >= RADIANS[1] for _, lat, lon in self._stamps):
            return
        if max(max(abs(lat), abs(lon)) for _, lat, lon in self._stamps) > SIMULATED:
            _, lat, lon = self._stamps[-1]
            self._note(
                "gnss: radians",
                f"latitude {lat:.4f}, longitude {lon:.4f} lie in the sea off Ghana: if the vehicle "
                "does not, they are in radians; let the driver publish degrees",
            )

    def _check_whole_seconds(self) -> None:
        if any(stamp % SECOND_NS for stamp, *_ in self._stamps):
            return
        shared = sum(
            last[0] == now[0] and last[1:] != now[1:]
            for last, now in itertools.pairwise(self._stamps)
        )
        if shared >= SHARED:
            self._note(
                "gnss: whole seconds",
                f"header.stamp has whole seconds only, and {shared} of the last {STAMPS_KEPT} "
                "fixes have the stamp of the one before: let the driver fill nanosec, or set "
                "use_receive_time: true",
            )

    def check_rate(self, ring: ImuRing) -> None:
        """Compare the IMU's rate with the lowest that is supported."""
        stamps = ring.latest(PERIOD_SAMPLES)["t_ns"]
        if len(stamps) < PERIOD_SAMPLES // 2:
            return
        rate = 1.0 / sample_period(stamps)
        if rate < SHARE * SLOWEST:
            self._inputs.note(
                "imu: too slow",
                f"imu/data: {rate:.1f} Hz: turns and vibration need at least {SLOWEST:g} Hz; raise "
                "the driver's rate",
            )

    def _note(self, name: str, text: str) -> None:
        self._inputs.note(name, f"gnss/fix: {text}")
