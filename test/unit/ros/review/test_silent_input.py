"""For how long input has not come, by the clock of its arrival, and what the log says of it."""

from hybrid_ins.ros.review.silent_input import OutageLog, Silence, why_missing

IMU = "sensor_msgs/msg/Imu"


def test_silence_grows_until_something_new_comes() -> None:
    silence = Silence()

    assert [silence.update(0, 1.0) for _ in range(3)] == [1.0, 2.0, 3.0]
    assert silence.update(100, 1.0) == 0.0
    assert [silence.update(100, 1.0) for _ in range(2)] == [1.0, 2.0]
    assert silence.update(0, 1.0) == 3.0  # a reset is no sample
    assert silence.update(100, 1.0) == 4.0
    assert silence.update(7, 1.0) == 0.0  # a bag that begins anew is


def test_an_outage_is_logged_once_and_its_end_as_well() -> None:
    lines: list[tuple[str, str]] = []
    outage = OutageLog(lambda level, text: lines.append((level, text)), "/imu/data")

    for seconds in (0.0, 9.0, 10.0, 11.0, 34.0, 0.0, 1.0, 0.0):
        outage.note(seconds, lambda: "start the driver")

    assert lines == [
        ("warn", "no messages on /imu/data for 10 s: start the driver"),
        ("info", "/imu/data: messages come, after 34 s"),
    ]
    outage.note(12.0, lambda: "start the driver")
    assert len(lines) == 3


def test_the_start_names_the_topics_that_could_be_meant() -> None:
    others = ["/cam/imu", "/imu/raw"]

    text = why_missing("imu/data", IMU, 0, others, "imu_topic")

    assert "choose /cam/imu or /imu/raw" in text
    assert "-r imu/data:=/cam/imu" in text and "imu_topic:=/cam/imu" in text
    assert "start the driver" in why_missing("imu/data", IMU, 0, [], "imu_topic")
    assert "a publisher (2)" in why_missing("imu/data", IMU, 2, others, "imu_topic")
