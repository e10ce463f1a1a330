"""Units and resolutions that are wrong are named once, from several messages; right ones never."""

from __future__ import annotations

import numpy as np
import pytest

from hybrid_ins.bags.messages import new_message
from hybrid_ins.core.imu.samples import ImuRing
from hybrid_ins.core.update.measurements import PositionFix
from hybrid_ins.ros.messages.conversions import Message, set_stamp
from hybrid_ins.ros.reporting.input_log import InputLog
from hybrid_ins.ros.review.input_units import InputUnits

USED = PositionFix(1, np.zeros(3), np.eye(3), np.zeros(3))


def message(t: float, lat: float = 48.1, lon: float = 11.6, altitude: float = 500.0) -> Message:
    fix = new_message("sensor_msgs/msg/NavSatFix")
    set_stamp(fix.header.stamp, round(t * 1e9))
    fix.latitude, fix.longitude, fix.altitude = lat, lon, altitude
    return fix


def noted(messages: list[Message]) -> dict[str, str]:
    """Return the notes after fixes, each warned of once."""
    lines: list[str] = []
    inputs = InputLog(lambda level, text: lines.append(f"{level}: {text}"))
    units = InputUnits(inputs)
    for one in messages:
        units.on_fix(one, USED)
    assert lines == [f"warn: {text}" for text in inputs.notes.values()]
    return inputs.notes


def moving(stamps: np.ndarray, **given: float) -> list[Message]:
    return [message(t, 48.1 + 1e-5 * k, **given) for k, t in enumerate(stamps)]


def test_right_fixes_are_not_remarked_on() -> None:
    stamps = 1000.0 + 0.2 * np.arange(50)
    assert not noted(moving(stamps))
    assert not noted(moving(np.round(1000.0 + np.arange(50.0)))), "1 Hz, on the second"
    assert not noted([message(t, 1e-5 * k, 0.0) for k, t in enumerate(stamps)]), "a simulator"
    assert not noted([message(t, 5.5, -0.2) for t in stamps]), "Accra"


def test_radians_are_named() -> None:
    stamps = 1000.0 + 0.2 * np.arange(50)
    found = noted([message(t, np.radians(48.1), np.radians(11.6)) for t in stamps])
    assert "radians; let the driver publish degrees" in found["gnss: radians"]
    assert "0.8395" in found["gnss: radians"]


def test_millimetres_are_named() -> None:
    found = noted([message(1000.0, altitude=545_000.0)])
    assert "545000 m" in found["gnss: unit of altitude"]


def test_whole_seconds_are_named() -> None:
    stamps = np.floor(1000.0 + 0.2 * np.arange(50))
    assert "nanosec" in noted(moving(stamps))["gnss: whole seconds"]
    assert not noted([message(t) for t in stamps]), "the same message again is another fault"
    assert not noted(moving(stamps + 0.25)), "a fraction: the driver fills it"


@pytest.mark.parametrize(("rate", "is_named"), [(20.0, True), (24.9, False), (25.0, False)])
def test_an_imu_that_is_too_slow_is_named(rate: float, is_named: bool) -> None:
    inputs, ring = InputLog(lambda level, text: None), ImuRing()
    for k in range(300):
        ring.push(round((100.0 + k / rate) * 1e9), 0.0, 0.0, -9.8, 0.0, 0.0, 0.0)
    InputUnits(inputs).check_rate(ring)
    assert ("imu/data: 20.0 Hz" in inputs.notes.get("imu: too slow", "")) == is_named
