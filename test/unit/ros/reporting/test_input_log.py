"""Counts of bad input, and how often they are told."""

from hybrid_ins.ros.messages.conversions import Refused
from hybrid_ins.ros.reporting.input_log import InputLog


def test_the_first_tenth_and_hundredth_of_a_name_are_told() -> None:
    lines: list[tuple[str, str]] = []
    inputs = InputLog(lambda level, text: lines.append((level, text)))

    for _ in range(250):
        inputs.count_and_warn("imu/data", Refused("imu: not finite", "NaN in the reading"))
    inputs.count_and_warn("gnss/fix", Refused("gnss: no fix", "status -1 means no fix"))

    assert inputs.counts == {"imu: not finite": 250, "gnss: no fix": 1}
    assert lines == [
        ("warn", "imu/data: NaN in the reading"),
        ("warn", "imu/data: NaN in the reading (10 so far)"),
        ("warn", "imu/data: NaN in the reading (100 so far)"),
        ("warn", "gnss/fix: status -1 means no fix"),
    ]
