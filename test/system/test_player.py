"""ins_play against a node in another process: what is sent, when, and what is recorded of it."""

import math
import os
import re
import signal
import sys
import time
from pathlib import Path
from subprocess import PIPE, Popen

import numpy as np
import pytest
from support.paths import ROOT

from hybrid_ins.bags.mcap_writer import CHUNK_SIZE
from hybrid_ins.bags.messages import absolute, new_message
from hybrid_ins.bags.reader import BagReader
from hybrid_ins.bags.writer import BagWriter
from hybrid_ins.cli import play as program
from hybrid_ins.playback import ESTIMATES, NOT_PLAYED
from hybrid_ins.ros.messages.cdr import ImuDecoder
from hybrid_ins.ros.messages.interface import PUBLISHED
from hybrid_ins.ros.messages.type_names import IMU
from tools.processes import Processes

pytest.importorskip("rclpy", reason="no ROS 2 Python packages")
from hybrid_ins.ros.player import Timeline

pytestmark = pytest.mark.live

ENVIRONMENT = {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
START_NS = 1_700_000_000_000_000_000
RATE = 500  # Hz
SECONDS = 4
ECHOES = ["/odometry", "/diagnostics", "/datum"]


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag of four seconds at 500 Hz; sample k shows k as its specific force."""
    path = tmp_path_factory.mktemp("player") / "flight.mcap"
    imu, fix, odometry = (
        new_message(name) for name in (IMU, "sensor_msgs/msg/NavSatFix", "nav_msgs/msg/Odometry")
    )
    with BagWriter(path) as bag:
        for k in range(RATE * SECONDS):
            stamp_ns = START_NS + k * 1_000_000_000 // RATE
            imu.header.stamp.sec, imu.header.stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
            imu.linear_acceleration.x = float(k)
            bag.write("/imu/data", imu, stamp_ns + 1000)
            if k % (RATE // 5) == 0:
                bag.write("/gnss/fix", fix, stamp_ns + 2000)
                bag.write("/truth/odometry", odometry, stamp_ns)
                bag.write("/odometry", odometry, stamp_ns)
    return path


@pytest.fixture
def echo(processes: Processes) -> "Popen[str]":
    """A node that answers; it prints what it saw when it ends."""
    process = processes.start(
        [sys.executable, ROOT / "test/support/echo_node.py"], PIPE, ENVIRONMENT
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


def start_player(processes: Processes, *words: object) -> "Popen[str]":
    command = [sys.executable, "-m", "hybrid_ins.cli.play", *map(str, words)]
    return processes.start(command, PIPE, ENVIRONMENT)


def play(processes: Processes, *words: object, status: int = 0) -> str:
    process = start_player(processes, *words)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == status, output
    return output


def seen_by(processes: Processes, echo: "Popen[str]") -> str:
    processes.stop(echo)
    assert echo.stdout is not None
    return echo.stdout.read()


# --- what arrives ---------------------------------------------------------------------------------


def test_everything_arrives_and_everything_that_comes_back_is_recorded(
    processes: Processes, echo: "Popen[str]", flight: Path, tmp_path: Path
) -> None:
    out = tmp_path / "estimate"
    report = play(processes, flight, "--record", out, "--record-topics", *ECHOES)
    seen = seen_by(processes, echo)
    assert f"'imu': {RATE * SECONDS}, " in seen
    assert "'fix': 20" in seen
    ticks = int(re.findall(r"'clock': (\d+)", seen)[0])
    assert 40 * SECONDS <= ticks <= 40 * (SECONDS + 2)
    assert "WARNING" not in report

    decode = ImuDecoder().decode
    with BagReader(flight) as bag:
        sent = [decode(data) for _, _, data in bag.raw("/imu/data")]
    with BagReader(out) as bag:
        assert (bag.count("/odometry"), bag.count("/diagnostics"), bag.count("/datum")) == (
            RATE * SECONDS,
            20,
            1,
        )
        answers = [(t, message) for _, t, message in bag.messages("/odometry")]
    stamps_ns = np.array([m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for _, m in answers])
    assert list(stamps_ns) == [sample.stamp_ns for sample in sent]
    assert [m.pose.pose.position.x for _, m in answers] == [s.specific_force[0] for s in sent]
    assert [m.twist.twist.linear.x for _, m in answers] == list(range(1, RATE * SECONDS + 1))
    latency = (np.array([t for t, _ in answers]) - stamps_ns) / 1e9
    assert latency.min() > 0.0
    assert np.median(latency) < 0.05  # milliseconds, but for a busy machine


@pytest.mark.slow
@pytest.mark.parametrize("rate", [0.5, 4.0])
def test_the_rate_is_held(
    processes: Processes, echo: "Popen[str]", flight: Path, tmp_path: Path, rate: float
) -> None:
    out = tmp_path / "estimate.mcap"
    selection = ("--rate", rate, "--start", 1, "--duration", 2)
    report = play(processes, flight, *selection, "--record", out, "--record-topics", "odometry")
    held = re.findall(r"rate ([\d.]+) \(asked", report)
    # Wide enough for a busy machine, too narrow for a rate that is ignored.
    assert float(held[0]) == pytest.approx(rate, rel=0.4)
    with BagReader(out) as bag:
        first, *_, last = (t for _, t, _ in bag.raw())
        assert bag.count("/odometry") == 2 * RATE
    assert first / 1e9 == pytest.approx(START_NS / 1e9 + 1.0, abs=0.5 * max(1.0, rate))
    assert (last - first) / 1e9 == pytest.approx(2.0, rel=0.4)
    ticks = int(re.findall(r"'clock': (\d+)", seen_by(processes, echo))[0])
    assert ticks >= 2 * 40 * max(1.0, 1.0 / rate)


@pytest.mark.slow
def test_topics_are_chosen_and_renamed(processes: Processes, flight: Path, tmp_path: Path) -> None:
    command = [
        sys.executable,
        ROOT / "test/support/echo_node.py",
        "--ros-args",
        "-r",
        "__ns:=/robot1",
    ]
    echo = processes.start(command, PIPE, ENVIRONMENT)
    out = tmp_path / "estimate.mcap"
    options = ("--topics", "imu/data", "--no-clock", "--record", out, "--record-topics", "odometry")
    remaps = ("--remap", "imu/data:=robot1/imu/data", "odometry:=robot1/odometry")
    play(processes, flight, *options, *remaps)
    with BagReader(out) as bag:
        assert bag.topics == {"/odometry": "nav_msgs/msg/Odometry"}
        assert bag.count("/odometry") == RATE * SECONDS
    assert "'clock': 0, 'fix': 0" in seen_by(processes, echo)


def test_without_anybody_there_it_says_so_and_plays(
    processes: Processes, flight: Path, tmp_path: Path
) -> None:
    out = tmp_path / "estimate.mcap"
    options = ("--wait", 0.2, "--rate", 10, "--drain", 0, "--record", out)
    report = play(processes, flight, *options, "--record-topics", "odometry", status=2)
    assert "no subscriber of /gnss/fix, /imu/data" in report.replace(
        "/imu/data, /gnss/fix", "/gnss/fix, /imu/data"
    )
    assert "no publisher of /odometry: not recorded" in report
    assert f"played {RATE * SECONDS + 20} messages" in report
    assert "ins_play: error: nothing came back to record: is the node running" in report
    assert not out.exists()


# --- ended early ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("number", "status"),
    [(signal.SIGINT, 130), pytest.param(signal.SIGTERM, 143, marks=pytest.mark.slow)],
    ids=["SIGINT", "SIGTERM"],
)
def test_ended_by_a_signal_the_recording_is_whole(
    processes: Processes,
    echo: "Popen[str]",
    flight: Path,
    tmp_path: Path,
    number: signal.Signals,
    status: int,
) -> None:
    out = tmp_path / "estimate"
    options = ("--rate", 0.2, "--record", out, "--record-topics", *ECHOES)
    process = start_player(processes, flight, *options)
    deadline = time.monotonic() + 30
    while not any(
        f.stat().st_size > 100_000 for f in tmp_path.glob("*.part/*")
    ):  # a chunk is written
        assert time.monotonic() < deadline
        time.sleep(0.05)
    process.send_signal(number)
    output, _ = process.communicate(timeout=20)
    assert process.returncode == status
    assert "Traceback" not in output
    assert "ends early, after" in output
    with BagReader(out) as bag:
        numbers = [m.twist.twist.linear.x for _, _, m in bag.messages("/odometry")]
    assert numbers == list(range(1, len(numbers) + 1))
    assert len(numbers) > 50


def test_killed_it_loses_seconds_at_most(
    processes: Processes, echo: "Popen[str]", flight: Path, tmp_path: Path
) -> None:
    """GIVEN a slow recording WHEN it is killed before a chunk is full THEN it can be read."""
    out = tmp_path / "estimate"
    options = ("--rate", 0.2, "--record", out, "--record-topics", *ECHOES)
    process = start_player(processes, flight, *options)
    deadline = time.monotonic() + 30
    while not any(f.stat().st_size > 2_000 for f in tmp_path.glob("*.part/*")):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    [file] = tmp_path.glob("*.part/*")
    process.kill()
    process.communicate(timeout=20)

    assert file.stat().st_size < CHUNK_SIZE
    with BagReader(tmp_path / "estimate.part") as bag:
        numbers = [m.twist.twist.linear.x for _, _, m in bag.messages("/odometry")]
    assert numbers == list(range(1, len(numbers) + 1))
    assert len(numbers) > 5


def test_what_the_node_publishes_is_recorded() -> None:
    given = {absolute(topic.name) for topic in PUBLISHED} - {"/tf"}
    assert set(ESTIMATES) == given
    assert {"/validity", "/aiding/verdict"} <= given <= set(NOT_PLAYED)


@pytest.mark.slow
def test_a_bag_that_is_damaged_midway_is_played_without_the_damage(
    processes: Processes, echo: "Popen[str]", flight: Path, tmp_path: Path
) -> None:
    data = bytearray(flight.read_bytes())
    data[len(data) // 2] ^= 1
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(data)
    out = tmp_path / "estimate.mcap"
    options = ("--record", out, "--record-topics", "odometry")
    output = play(processes, damaged, *options)
    assert "Traceback" not in output
    assert f"ins_play: warning: {damaged}: damaged at byte" in output
    with BagReader(out) as bag:
        assert RATE < bag.count("/odometry") < RATE * SECONDS


# --- wrong use ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["{missing}"], "no such file or directory"),
        (["{flight}", "--start", "99"], "--start 99: .* is only 4.0 s long"),
        (["{flight}", "--topics", "imu"], "--topics /imu: .* has /gnss/fix, /imu/data, "),
        (["{flight}", "--record", "{flight}"], "is the input"),
        (["{flight}", "--rate", "0"], "--rate: 0 is not above zero"),
        (["{flight}", "--rate", "fast"], "--rate: 'fast' is not a number"),
        (["{flight}", "--drain", "-1"], "--drain: -1 is negative"),
        (["{flight}", "--remap", "a=b"], "--remap: a=b is not of the form old:=new"),
        ([], "required: IN"),
    ],
)
def test_wrong_arguments(
    flight: Path,
    tmp_path: Path,
    words: list[str],
    complaint: str,
    capfd: pytest.CaptureFixture[str],
) -> None:
    words = [word.format(flight=flight, missing=tmp_path / "nothing") for word in words]
    try:
        status = program.main(words)
    except SystemExit as end:  # argparse
        status = int(end.code or 0)
    assert status == 2
    assert re.search(f"ins_play: error: .*{complaint}", capfd.readouterr().err)


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--remap", "/imu/data:=/a//b"], "'/a//b': .* must not contain repeated '/'"),
        (["--remap", "/imu/data:=/a b"], "'/a b': .* must not contain characters other"),
        (
            ["--record", "{out}", "--record-topics", "/a//b"],
            "'/a//b': .* must not contain repeated",
        ),
        (
            ["--record", "{out}", "--record-topics", "/a b"],
            "'/a b': .* must not contain characters other",
        ),
        (["--ros-args", "-r", "imu"], "Couldn't parse remap rule: '-r imu'$"),
        (["--ros-args", "--no-such"], "unknown ROS arguments: .*--no-such"),
    ],
)
def test_names_that_ros_refuses(
    processes: Processes, flight: Path, tmp_path: Path, words: list[str], complaint: str
) -> None:
    words = [word.format(out=tmp_path / "out") for word in words]
    output = play(processes, flight, *words, status=2)
    assert "Traceback" not in output
    assert re.search(f"^ins_play: error: .*{complaint}", output, re.MULTILINE)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_full_disk_ends_with_one_line(
    processes: Processes, echo: "Popen[str]", flight: Path, tmp_path: Path
) -> None:
    code = (
        "import resource, sys; from hybrid_ins.cli.play import main;"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, 400_000)); sys.exit(main())"
    )
    words = [flight, "--record", tmp_path / "out", "--record-topics", "odometry"]
    process = processes.start([sys.executable, "-c", code, *map(str, words)], PIPE, ENVIRONMENT)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 2
    assert "Traceback" not in output
    last = output.strip().splitlines()[-1]
    told = r"ins_play: error: .*out: cannot be written \(File too large\): make room.*"
    assert re.fullmatch(told, last)
    with BagReader(tmp_path / "out.part") as bag:
        assert bag.count("/odometry") > 100  # what there was room for


def test_late_subscribers_get_the_map_s_origin(processes: Processes) -> None:
    code = (
        "from hybrid_ins.ros.player import Player, started_node\n"
        "with started_node([]) as node:\n"
        "    topics = dict.fromkeys(['/datum', '/gnss/fix'], 'sensor_msgs/msg/NavSatFix')\n"
        "    Player(node, topics, {}, latched=['/datum'])\n"
        "    for topic in topics:\n"
        "        info = node.get_publishers_info_by_topic(topic)\n"
        "        print(info[0].qos_profile.durability.name)\n"
    )
    process = processes.start([sys.executable, "-c", code], PIPE, ENVIRONMENT)
    output, _ = process.communicate(timeout=60)
    assert output.split() == ["TRANSIENT_LOCAL", "VOLATILE"]


def test_times_that_the_clock_cannot_tell(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    later = tmp_path / "later.mcap"
    with BagWriter(later) as bag:
        bag.write("/imu/data", new_message(IMU), 2**31 * 10**9)
    assert program.main([str(later), "--wait", "0", "--drain", "0"]) == 2
    assert "ins_play: error: " in (said := capfd.readouterr().err) and "--no-clock" in said
    assert program.main([str(later), "--wait", "0", "--drain", "0", "--no-clock"]) == 0


def test_a_renamed_topic_that_is_not_there_is_named(
    flight: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    words = ["--duration", "0.1", "--wait", "0", "--drain", "0", "--remap"]
    assert program.main([str(flight), *words, "/imu/dat:=/imu", "/imu/data:=/imu"]) == 0
    assert "--remap /imu/dat: neither played nor recorded" in capfd.readouterr().err


def test_what_is_latched_before_the_start_is_played(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """GIVEN a bag that begins with /tf_static WHEN it is played from later THEN that holds."""
    imu, transforms = new_message(IMU), new_message("tf2_msgs/msg/TFMessage")
    with BagWriter(tmp_path / "bag.mcap") as bag:
        bag.write("/tf_static", transforms, START_NS)
        bag.write("/truth/datum", new_message("sensor_msgs/msg/NavSatFix"), START_NS)
        for k in range(5):
            bag.write("/imu/data", imu, START_NS + k * 1_000_000_000)
    given = [str(tmp_path / "bag.mcap"), "--start", "3.5", "--wait", "0", "--drain", "0"]

    assert program.main([*given, "--topics", "/imu/data", "/truth/datum"]) == 0
    played = re.findall(r"(/\S+) +(\d+)$", capfd.readouterr().out, re.MULTILINE)
    assert dict(played) == {"/imu/data": "1", "/truth/datum": "1"}
    assert program.main(given) == 0
    said = capfd.readouterr()
    assert re.search("/tf_static +1$", said.out, re.MULTILINE) or (  # the wheels have no tf2_msgs
        "/tf_static is left out: tf2_msgs/msg/TFMessage is not installed" in said.err
    )


def test_only_truth_in_the_bag(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with BagWriter(tmp_path / "bag.mcap") as bag:
        bag.write("/truth/odometry", new_message("nav_msgs/msg/Odometry"), START_NS)
    assert program.main([str(tmp_path / "bag.mcap")]) == 2
    assert "has only /truth/odometry: name what to play with --topics" in capfd.readouterr().err


def test_without_ros(
    flight: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "rclpy", None)
    for module in ("player", "recorder"):
        monkeypatch.delitem(sys.modules, f"hybrid_ins.ros.{module}", raising=False)
    assert program.main([str(flight)]) == 2
    assert "ins_play: error: ROS 2 is not installed" in capfd.readouterr().err


# --- bag time -------------------------------------------------------------------------------------


def test_the_clock_goes_on_at_any_rate(processes: Processes, tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag.mcap") as bag:
        bag.write("/imu/data", new_message(IMU), START_NS)
    output = play(processes, tmp_path / "bag.mcap", "--rate", "1e-9", "--wait", "0", "--drain", "0")
    assert "played 1 messages" in output


def test_bag_time_never_passes_a_message_that_is_not_out() -> None:
    timeline = Timeline(START_NS, rate=100.0)
    assert timeline.now_ns() == START_NS
    timeline.start()
    time.sleep(0.02)
    assert timeline.now_ns() == START_NS
    late = timeline.wait_until(START_NS + 1_000_000_000)
    assert late >= 0.0
    assert timeline.now_ns() == START_NS + 1_000_000_000
    timeline.next_ns = START_NS + 10**12
    assert timeline.now_ns() > START_NS + 1_000_000_000
    assert math.isclose(timeline.elapsed(), 0.02, abs_tol=0.1)
