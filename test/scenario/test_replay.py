"""Recordings through ``ins_replay``: when its output was known, and the track for other tools."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.bags import with_unstamped_pressure

from hybrid_ins.bags.messages import new_message
from hybrid_ins.bags.reader import BagReader, InputTopics
from hybrid_ins.bags.writer import BagWriter
from hybrid_ins.cli import replay, simulate
from hybrid_ins.evaluation.run_reader import read_run
from hybrid_ins.parameters import check_all
from hybrid_ins.replay import _Replay, replay_bag
from hybrid_ins.ros.messages.conversions import set_stamp, stamp_ns
from tools.robustness.disturbances import Flight, change_stamps

DUE = "/imu/bias", "/q/accelerometer", "/q/gyroscope", "/gnss/filtered", "/diagnostics"


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a flight with an outage."""
    path = tmp_path_factory.mktemp("replay") / "flight.mcap"
    arguments = f"{path} --duration 30 --imu-rate 100 --outage 15 10 --seed 5"
    assert simulate.main(arguments.split()) == 0
    return path


@pytest.mark.parametrize(
    "smooth",
    [[], pytest.param(["--smooth"], marks=pytest.mark.slow)],
    ids=["filter", "smoother"],
)
def test_output_has_the_log_time_at_which_it_was_known(
    flight: Path, smooth: list[str], tmp_path: Path
) -> None:
    # GIVEN a flight with an outage, in which no message but the IMU's comes
    out = tmp_path / "out.mcap"
    # WHEN it is replayed
    assert replay.main([str(flight), str(out), *smooth]) == 0
    # THEN what is published in the outage lies in it, and nothing arrives late
    with BagReader(out) as bag:
        start_ns = bag.start_ns
        for topic in DUE:
            times = [(log_ns, stamp_ns(m.header.stamp)) for _, log_ns, m in bag.messages(topic)]
            log_ns, stamps = np.array(times).T
            assert np.abs(log_ns - stamps).max() <= 100_000_000, topic
            inside = np.diff(log_ns[((log_ns - start_ns) * 1e-9 > 16.0)])
            assert inside.max() <= 1_100_000_000, topic


@pytest.mark.parametrize("phase", ["filter", "smooth"])
def test_a_smoothed_run_that_is_interrupted_leaves_nothing(
    flight: Path, phase: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """GIVEN Ctrl-C before the smoother's last state THEN no bag seems to hold smoothed states."""
    out = tmp_path / "out.mcap"
    real = getattr(_Replay, phase)

    def interrupted(run: _Replay, *arguments: Any) -> None:
        real(run, *arguments)
        raise KeyboardInterrupt

    monkeypatch.setattr(_Replay, phase, interrupted)

    assert replay.main([str(flight), str(out), "--smooth"]) == 130
    assert not list(tmp_path.iterdir())
    if phase == "filter":  # What a filter found until then is of use.
        assert replay.main([str(flight), str(out)]) == 130
        assert [path.name for path in tmp_path.iterdir()] == ["out.mcap"]


@pytest.mark.parametrize("is_given", [False, True], ids=["heading unknown", "heading given"])
def test_rates_in_degrees_are_told_at_the_end(
    is_given: bool, flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """GIVEN rates in deg/s WHEN only positions come of them THEN that is a failure."""
    bag, out = tmp_path / "bag.mcap", tmp_path / "out.mcap"
    with BagReader(flight) as source, BagWriter(bag) as target:
        for topic, log_ns, message in source.messages("/imu/data", "/gnss/fix"):
            if topic == "/imu/data":
                rate = message.angular_velocity
                rate.x, rate.y, rate.z = np.degrees((rate.x, rate.y, rate.z)).tolist()
            target.write(topic, message, log_ns)
    heading = ["-p", "alignment.heading_source:=parameter", "-p", "alignment.yaw:=1.5708"]

    status = replay.main([str(bag), str(out), *(heading if is_given else [])])

    said = capsys.readouterr()
    last = (said.out if is_given else said.err).splitlines()[-1]
    assert (status, out.exists()) == ((0, True) if is_given else (2, False))
    assert "it is in degrees per second" in last


def test_a_search_for_the_heading_is_published_and_not_scored(flight: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    assert replay.main([str(flight), str(out)]) == 0

    with BagReader(out) as bag:
        published, local = (
            np.array([stamp_ns(m.header.stamp) for _, _, m in bag.messages(topic)])
            for topic in ("/odometry", "/odometry/local")
        )
    assert published[0] < local[0] - 2_000_000_000
    assert (np.diff(published) > 0).all()
    run = read_run(out)
    assert run.estimate.stamp_ns[0] == local[0]
    assert any("before the heading was known: not scored" in note for note in run.notes)


@pytest.mark.parametrize("by_receipt", [True, False])
def test_without_stamps_the_time_of_arrival_is_used_where_that_is_asked_for(
    flight: Path, tmp_path: Path, by_receipt: bool
) -> None:
    # GIVEN a recording whose drivers do not stamp; one of them is enough to be refused
    disturbed, out = tmp_path / "disturbed.mcap", tmp_path / "out.mcap"
    recorded = Flight.read(flight, 0.0, 100.0)
    for topic in ("/gnss/fix", "/imu/data")[: 1 + by_receipt]:
        change_stamps(topic, lambda t_ns, _: 0)(recorded)
    recorded.write(disturbed)

    words = ["--param", f"use_receive_time:={by_receipt}".lower()]
    status = replay.main([str(disturbed), str(out), *words])

    assert (status == 0) is by_receipt
    if by_receipt:
        assert read_run(out).estimate.stamp_ns[-1] > 1_000_000_000_000_000_000


def test_aiding_sensors_without_stamps_are_used_by_the_time_of_arrival(
    flight: Path, tmp_path: Path
) -> None:
    # GIVEN a recording with an altimeter whose driver does not stamp
    unstamped = with_unstamped_pressure(flight, tmp_path / "unstamped.mcap")

    topics: InputTopics = {
        "imu_topic": "/imu/data", "fix_topic": "/gnss/fix", "velocity_topic": "/gnss/velocity"
    }  # fmt: skip
    counts = []
    for by_receipt in (False, True):
        values = check_all({"use_receive_time": by_receipt})
        replayed = replay_bag(unstamped, tmp_path / f"{by_receipt}.mcap", values, topics)
        counts.append(replayed.estimator.inputs.counts)

    # THEN it is refused, unless the time of arrival is asked for
    assert [any("aiding" in name for name in one) for one in counts] == [True, False]


def test_an_optional_topic_of_another_type_is_named(
    flight: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """GIVEN velocities as a driver for NMEA publishes them THEN it is said that they are unused."""
    path = tmp_path / "stamped.mcap"
    with BagReader(flight) as bag, BagWriter(path) as out:
        for topic, log_ns, data in bag.raw("/imu/data", "/gnss/fix"):
            out.write_raw(topic, bag.topics[topic], data, log_ns)
        out.write("/vel", new_message("geometry_msgs/msg/TwistStamped"), bag.start_ns)

    assert replay.main([str(path), str(tmp_path / "out.mcap"), "--velocity-topic", "/vel"]) == 0
    told = "/vel is geometry_msgs/msg/TwistStamped, not geometry_msgs/msg/TwistWithCovariance"
    assert told in capfd.readouterr().err


@pytest.mark.parametrize("given", ["vel", "/vel", "gnss/vel"])
def test_velocities_are_found_with_or_without_a_slash_or_missed_aloud(
    flight: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], given: str
) -> None:
    path, out = tmp_path / "renamed.mcap", tmp_path / "out.mcap"
    with BagReader(flight) as bag, BagWriter(path) as renamed:
        for topic, log_ns, data in bag.raw("/imu/data", "/gnss/fix"):
            renamed.write_raw(topic, bag.topics[topic], data, log_ns)
        velocity = new_message("geometry_msgs/msg/TwistWithCovarianceStamped")
        renamed.write("/vel", velocity, bag.start_ns)

    assert replay.main([str(path), str(out), "--velocity-topic", given]) == 0

    with BagReader(out) as bag:
        assert ("/gnss/velocity" in bag.topics) is (given != "gnss/vel")
    told = "has no topic /gnss/vel: no velocities are used; there is /vel"
    assert (told in capfd.readouterr().err) is (given == "gnss/vel")


def test_a_datum_given_for_stamps_since_the_boot_is_written_at_the_time_of_arrival(
    flight: Path, tmp_path: Path
) -> None:
    # GIVEN a recording whose IMU stamps by seconds since its boot
    path, out = tmp_path / "since_boot.mcap", tmp_path / "out.mcap"
    with BagReader(flight) as bag, BagWriter(path) as since_boot:
        for topic, log_ns, message in bag.messages("/imu/data", "/gnss/fix"):
            set_stamp(message.header.stamp, log_ns - bag.start_ns + 10**11)
            since_boot.write(topic, message, log_ns)
        start_ns, end_ns = bag.start_ns, bag.end_ns

    words = ["-p", "use_receive_time:=true", "-p", "datum:=[32.1, 34.8, 0.0]"]
    assert replay.main([str(path), str(out), *words]) == 0

    # THEN everything lies within the recording
    with BagReader(out) as bag:
        assert start_ns <= bag.start_ns <= bag.end_ns <= end_ns + 10**9


def test_a_replayed_track_is_exported(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tum, kml = tmp_path / "track.tum", tmp_path / "track.kml"
    arguments = [
        str(flight),
        str(tmp_path / "out.mcap"),
        "--export",
        str(tum),
        "--export",
        str(kml),
        *("-p", "gnss.time_offset.estimate:=false"),
    ]
    assert replay.main(arguments) == 0
    assert f"trajectory: {tum}\ntrajectory: {kml}" in capsys.readouterr().out
    assert len(np.loadtxt(tum)) > 1500
    assert kml.read_text(encoding="utf-8").startswith("<?xml")


def test_an_export_that_cannot_be_written_is_refused_before_the_work(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.mcap"
    assert replay.main([str(flight), str(out), "--export", str(tmp_path / "track.doc")]) == 2
    assert "track.doc: the name of an export ends in one of" in capsys.readouterr().err
    assert not out.exists()


def test_files_that_exist_and_inputs_are_not_replaced_by_an_export(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mine, out = tmp_path / "mine.csv", tmp_path / "out.mcap"
    mine.write_text("/**: {ros__parameters: {}}")

    assert replay.main([str(flight), str(out), "--export", str(mine)]) == 2
    assert f"{mine}: exists: give --overwrite" in capsys.readouterr().err
    given = ["--params-file", str(mine), "--export", str(mine), "--overwrite"]
    assert replay.main([str(flight), str(out), *given]) == 2
    assert "is the input itself" in capsys.readouterr().err
    assert "ros__parameters" in mine.read_text()
    assert not out.exists()
