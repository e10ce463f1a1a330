"""What callbacks raise is counted and told in one line, and goes no further."""

from hybrid_ins.ros.callback_guard import CallbackGuard
from hybrid_ins.ros.reporting.input_log import InputLog


def make() -> tuple[CallbackGuard, InputLog, list[str]]:
    lines: list[str] = []
    inputs = InputLog(lambda level, text: lines.append(text))
    return CallbackGuard(inputs), inputs, lines


def test_bytes_that_cannot_be_decoded_are_refused_under_the_topics_name() -> None:
    guard, inputs, lines = make()
    received: list[int] = []
    on_bytes = guard.decoding("gnss/fix", lambda data: data[4], received.append)

    on_bytes(b"\0\1\0\0")
    on_bytes(b"\0\1\0\0\7")

    assert received == [7]
    assert inputs.counts == {"gnss/fix: not decodable": 1}
    assert "4 bytes" in lines[0] and "publisher" in lines[0]


def test_an_error_of_a_callback_is_told_with_its_place() -> None:
    guard, inputs, lines = make()

    def fail(value: int) -> None:
        raise ZeroDivisionError("one\ntwo" * 1000)

    guard.decoding("imu/data", lambda data: 0, fail)(b"")
    guard.wrap(fail)(3)

    assert inputs.counts == {"internal error": 2}
    [line] = lines
    assert "ZeroDivisionError in test_callback_guard.py:" in line and len(line) < 400
    assert "\n" not in line
