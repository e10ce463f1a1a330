"""The real node over DDS, in a process of its own: what it publishes, answers and survives."""

from __future__ import annotations

import importlib.util
import math
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.bags import with_unstamped_pressure
from support.ros_nodes import ENVIRONMENT, HEADING, Client, start_node, start_player, until

from hybrid_ins import parameters
from hybrid_ins.bags.reader import BagReader
from hybrid_ins.cli import replay, simulate
from hybrid_ins.core.inertial.rotations import quat_conjugate, quat_multiply, rotvec_from_quat
from hybrid_ins.ros.placement.static_transforms import NOT_PLACED
from tools.processes import Processes

rclpy = pytest.importorskip("rclpy", reason="no ROS 2 Python packages")

pytestmark = pytest.mark.live

DURATION = 20.0
RATE = 2.0
HAS_TF2 = importlib.util.find_spec("tf2_msgs") is not None  # before other tests compile it


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("node")


@pytest.fixture(scope="module")
def flight(folder: Path) -> Path:
    bag = folder / "flight.mcap"
    assert simulate.main([str(bag), "--duration", str(DURATION), "--imu-rate", "200"]) == 0
    return bag


@pytest.fixture(scope="module")
def recorded(folder: Path, flight: Path) -> tuple[Path, str, int]:
    """What the live node published of a flight, its log, and its exit status after SIGTERM."""
    log = folder / "node.log"
    for trial in range(3):  # a busy machine may lose samples of the IMU: play the flight again
        out = folder / f"live_{trial}.mcap"
        with Processes() as processes:
            node = start_node(processes, log)
            player = start_player(processes, flight, out, RATE)
            text, _ = player.communicate(timeout=90)
            assert player.returncode == 0, text
            status = processes.stop(node)
        if len(odometry(out)) > (DURATION - 1.0) * 200:
            break
    return out, log.read_text(), status


def odometry(bag: Path) -> dict[int, Any]:
    with BagReader(bag) as reader:
        return {
            m.header.stamp.sec * 1_000_000_000 + m.header.stamp.nanosec: m
            for _, _, m in reader.messages("/odometry")
        }


def vector(v: Any) -> np.ndarray[Any, Any]:
    return np.array([v.x, v.y, v.z])


def quaternion(q: Any) -> np.ndarray[Any, Any]:
    return np.array([q.x, q.y, q.z, q.w])


def test_live_odometry_is_that_of_the_replay(
    recorded: tuple[Path, str, int], flight: Path, folder: Path
) -> None:
    """GIVEN a bag WHEN played into the node and replayed THEN both estimate the same."""
    offline = folder / "replayed.mcap"
    overrides = [word for value in HEADING for word in ("-p", value)]
    assert replay.main([str(flight), str(offline), *overrides]) == 0

    live, replayed = odometry(recorded[0]), odometry(offline)

    assert len(live) > 0.99 * len(replayed) > 0.9 * DURATION * 200
    common = live.keys() & replayed.keys()
    assert len(common) > 0.99 * len(live)
    for stamp in common:
        a, b = live[stamp], replayed[stamp]
        away = vector(a.pose.pose.position) - vector(b.pose.pose.position)
        turn = quat_multiply(
            quat_conjugate(quaternion(a.pose.pose.orientation)), quaternion(b.pose.pose.orientation)
        )
        assert np.linalg.norm(away) < 0.01
        assert np.linalg.norm(rotvec_from_quat(turn)) < math.radians(0.1)
        assert np.allclose(a.pose.covariance, b.pose.covariance, rtol=0.05, atol=1e-6)


@pytest.mark.parametrize("by_receipt", [True, False])
def test_aiding_sensors_are_dated_by_receipt_where_that_is_asked_for(
    flight: Path, tmp_path: Path, by_receipt: bool
) -> None:
    bag, log = with_unstamped_pressure(flight, tmp_path / "unstamped.mcap"), tmp_path / "node.log"
    with Processes() as processes:
        start_node(processes, log, "-p", f"use_receive_time:={by_receipt}".lower())
        player = start_player(processes, bag, tmp_path / "out.mcap", RATE)
        text, _ = player.communicate(timeout=90)

    assert player.returncode == 0, text
    assert ("aiding/pressure: header.stamp is zero" in log.read_text()) is not by_receipt


def test_every_topic_is_published_with_its_frames(
    recorded: tuple[Path, str, int], flight: Path
) -> None:
    with BagReader(recorded[0]) as reader:
        counts = {topic: reader.count(topic) for topic in reader.topics}
        last = {topic: message for topic, _, message in reader.messages()}
        verdicts = [message for _, _, message in reader.messages("/gnss/verdict")]
    with BagReader(flight) as reader:
        fixes = [m.header.stamp for _, _, m in reader.messages("/gnss/fix")]

    assert counts["/datum"] == 1
    # One for each fix, but that of the first may be published before the recorder is there.
    judged = [{v.key: v.value for v in verdict.values}["stamp"] for verdict in verdicts]
    stamps = [str(stamp.sec * 1_000_000_000 + stamp.nanosec) for stamp in fixes]
    assert judged[-len(stamps) + 1 :] == stamps[1:]
    assert len(judged) <= len(stamps)
    for topic in ("/gnss/filtered", "/q/accelerometer", "/q/gyroscope", "/imu/bias"):
        assert counts[topic] > 9 * (DURATION - 2), topic
    assert counts["/diagnostics"] >= DURATION - 2
    odom = last["/odometry"]
    assert (odom.header.frame_id, odom.child_frame_id) == ("map", "base_link")
    assert last["/gnss/filtered"].position_covariance_type == 3
    # MPU-9250 noise, read off the IMU by the regressor.
    assert 2e-4 < last["/q/accelerometer"].vector.x < 8e-4
    assert 2e-6 < last["/q/gyroscope"].vector.x < 8e-6


def test_sigterm_ends_the_node_in_order(recorded: tuple[Path, str, int]) -> None:
    _, log, status = recorded
    assert status == 0, log
    assert "Traceback" not in log


def test_a_node_without_tf2_warns_that_nobody_gives_the_places_of_sensors(
    recorded: tuple[Path, str, int],
) -> None:
    lines = [line for line in recorded[1].splitlines() if NOT_PLACED in line]

    assert len(lines) == (0 if HAS_TF2 else 1)
    assert all("[WARN]" in line for line in lines)


def test_control_of_an_idle_node(processes: Processes, folder: Path, client: Client) -> None:
    """GIVEN a node without data THEN it says so, answers, and refuses nonsense with a reason."""
    from std_srvs.srv import Trigger

    log = folder / "idle.log"
    node = start_node(processes, log, "-p", "gnss.patiense:=3.0")
    assert "gnss.patiense: unknown; did you mean gnss.patience?" in log.read_text()

    client.spin_until(lambda: client.diagnostics)
    texts = [status.message for status in client.diagnostics[0].status]
    assert any("no messages on /imu/data" in text for text in texts), texts
    assert any("waiting for" in text for text in texts), texts

    assert client.set("noise.mode", "constant").successful
    assert client.set("gnss.patience", 5.0).successful
    assert client.set("noise.q_accelerometer", "1e-6").successful  # as ros2 param sends it
    assert client.set("noise.background_gyroscope", "[0.1, 0, 1e-08]").successful
    from rcl_interfaces.srv import GetParameters

    names = ["noise.q_accelerometer", "noise.background_gyroscope"]
    values = client.call(
        GetParameters, "/ins_node/get_parameters", GetParameters.Request(names=names)
    ).values
    assert values[0].double_value == 1e-6
    assert list(values[1].double_array_value) == [0.1, 0.0, 1e-8]
    assert not client.set("noise.q_accelerometer", "much").successful
    assert not client.set("odometry_rate", 5e-324).successful
    os.mkfifo(folder / "pipe.onnx")
    assert client.set("noise.mode", "learned").successful
    (folder / "damaged.onnx").write_bytes(b"no model")
    for model, reason in (
        (folder / "pipe.onnx", "not a regular file"),
        (folder / "damaged.onnx", "damaged.onnx: "),
        ("/nope.onnx", "/nope.onnx: No such file or directory"),
        ("platoon", "noise.model is plateau, spectral, paper, or"),
        ("m" * 300, "noise.model is plateau, spectral, paper, or"),
        ("x" * 300 + ".onnx", "File name too long"),
    ):
        refused = client.set("noise.model", str(model))
        assert not refused.successful and reason in refused.reason, refused
    assert "the spectral estimator is used" not in log.read_text()
    refused = client.set("gnss.patience", -1.0)
    assert not refused.successful
    assert "gnss.patience" in refused.reason
    refused = client.set("gnss.patiense", 5.0)
    assert not refused.successful
    assert "gnss.patiense: unknown; did you mean gnss.patience?" in refused.reason
    refused = client.set("imu.position", [1.0, 0.0, 0.0])
    assert not refused.successful
    assert "read-only" in refused.reason

    assert client.call(Trigger, "/ins_node/reset", Trigger.Request()).success
    before = len(client.diagnostics)
    node.terminate()
    client.spin_until(
        lambda: any("shut down" in d.status[0].message for d in client.diagnostics[before:])
    )
    assert node.wait(10.0) == 0
    assert "Traceback" not in log.read_text()


def test_an_imu_that_is_missing_is_named_and_one_that_dies_is_lost(
    processes: Processes, folder: Path, flight: Path, client: Client
) -> None:
    """GIVEN a wrong topic, then the right one WHEN the flight ends THEN log and validity say so."""
    from diagnostic_msgs.msg import DiagnosticStatus
    from rclpy.qos import DurabilityPolicy, QoSProfile

    log, topic, told = folder / "silent.log", "/vehicle/imu", []
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    client.node.create_subscription(DiagnosticStatus, "/validity", told.append, latched)
    start_node(processes, log, "-r", f"imu/data:={topic}")
    play = [sys.executable, "-m", "hybrid_ins.cli.play", str(flight)]
    elsewhere = processes.start(play, subprocess.DEVNULL, ENVIRONMENT)

    until(lambda: f"no messages on {topic} for" in log.read_text(), 30.0)
    line = next(line for line in log.read_text().splitlines() if "no messages on" in line)
    assert "[WARN]" in line and "choose /imu/data with -r imu/data:=/imu/data" in line
    processes.stop(elsewhere)
    processes.start(
        [*play, "--rate", "4", "--remap", f"/imu/data:={topic}"], subprocess.DEVNULL, ENVIRONMENT
    )
    client.spin_until(lambda: told and told[-1].message.startswith("position good"), 60.0)
    client.spin_until(lambda: told[-1].message.startswith("position lost, velocity lost"), 30.0)

    client.spin_until(lambda: "no IMU samples for" in client.diagnostics[-1].status[0].message)
    last = {status.name: status for status in client.diagnostics[-1].status}
    assert last["hybrid_ins: filter"].level == b"\2"
    assert last["hybrid_ins: validity"].message == told[-1].message
    assert f"{topic}: messages come, after" in log.read_text()


def test_what_is_due_each_second_does_not_wait_for_a_clock_that_is_set_back(
    client: Client,
) -> None:
    """GIVEN the system's clock is set back THEN the steady clock calls the timer all the same."""
    from rclpy.clock import ClockType

    from hybrid_ins.ros.live_estimator import LiveEstimator

    live = LiveEstimator(client.node, parameters.defaults(), lambda level, text: None)
    live.advertise()
    live.activate()

    clocks = [timer.clock.clock_type for timer in client.node.timers]

    live.deactivate("inactive")
    live.destroy()
    assert clocks == [ClockType.STEADY_TIME]


@pytest.mark.slow
def test_second_publisher_is_told_and_leaves_the_state_alone(
    processes: Processes, folder: Path, flight: Path, client: Client
) -> None:
    """GIVEN a flight WHEN another node publishes on imu/data, too THEN both are named."""
    from sensor_msgs.msg import Imu

    log, out, offline = (
        folder / name for name in ("crowded.log", "crowded.mcap", "crowded_replayed.mcap")
    )
    overrides = [word for value in HEADING for word in ("-p", value)]
    assert replay.main([str(flight), str(offline), *overrides]) == 0
    node = start_node(processes, log)
    player = start_player(processes, flight, out, RATE)
    intruder = client.node.create_publisher(Imu, "/imu/data", 10)
    yesterday = Imu()
    yesterday.header.stamp.sec, yesterday.linear_acceleration.z = 1000, 99.0
    client.spin_until(
        lambda: client.diagnostics and client.diagnostics[-1].status[0].level == b"\0"
    )
    end = time.monotonic() + 60.0
    while player.poll() is None and time.monotonic() < end:
        intruder.publish(yesterday)
        client.executor.spin_once(0.02)
    assert player.returncode == 0

    assert "/imu/data has 2 publishers" in log.read_text()
    assert "asking" in log.read_text()
    assert "stop or remap all but one" in log.read_text()
    counted = {v.key: v.value for d in client.diagnostics for s in d.status for v in s.values}
    assert int(counted["imu/data: several publishers"]) == 1
    assert int(counted["imu: stamp jumps"]) > 20
    live, replayed = odometry(out), odometry(offline)
    common = live.keys() & replayed.keys()
    assert len(common) > 0.98 * len(replayed)
    # Each sample of the intruder would add 0.5 m/s. What a busy machine loses costs centimetres,
    # and delays a fix by a sample.
    moved = [
        np.linalg.norm(vector(a.pose.pose.position) - vector(b.pose.pose.position)) > 0.1
        or np.linalg.norm(vector(a.twist.twist.linear) - vector(b.twist.twist.linear)) > 0.1
        for a, b in ((live[stamp], replayed[stamp]) for stamp in common)
    ]
    assert np.mean(moved) < 0.01
    assert processes.stop(node) == 0


def test_a_second_source_of_odometry_is_named(
    processes: Processes, tmp_path: Path, client: Client
) -> None:
    """GIVEN a node that was forgotten WHEN another is started THEN it says so."""
    from nav_msgs.msg import Odometry

    log = tmp_path / "node.log"
    client.node.create_publisher(Odometry, "/odometry", 10)

    start_node(processes, log)

    until(lambda: "/odometry has 2 publishers" in log.read_text())
    line = next(line for line in log.read_text().splitlines() if "2 publishers" in line)
    assert "asking" in line and "is another ins_node running? Stop the other" in line


def test_no_bytes_on_any_topic_end_the_node(
    processes: Processes, folder: Path, client: Client
) -> None:
    """GIVEN bytes that are no message WHEN they come on every input THEN they are counted."""
    from geometry_msgs.msg import PoseWithCovarianceStamped, TwistWithCovarianceStamped
    from rclpy.serialization import serialize_message
    from sensor_msgs.msg import Imu, NavSatFix
    from std_srvs.srv import Trigger

    log = folder / "bytes.log"
    node = start_node(processes, log)
    topics = {
        "/imu/data": Imu,
        "/gnss/fix": NavSatFix,
        "/gnss/velocity": TwistWithCovarianceStamped,
        "/initialpose": PoseWithCovarianceStamped,
    }
    publishers = {topic: client.node.create_publisher(k, topic, 500) for topic, k in topics.items()}
    client.spin_until(lambda: all(p.get_subscription_count() for p in publishers.values()))
    rng = np.random.default_rng(0)
    for topic, kind in topics.items():
        sound = serialize_message(kind())
        broken = [b"\0\1\0\0", sound[: len(sound) // 2], sound[:4] + b"\xff" * 40]
        flipped = np.frombuffer(sound, np.uint8).copy()
        for _ in range(30):
            flipped[rng.integers(4, len(flipped), 4)] = rng.integers(0, 256, 4)
            broken += [flipped.tobytes(), b"\0\1\0\0" + rng.bytes(int(rng.integers(1, 400)))]
        for data in broken:
            publishers[topic].publish(data)
            client.executor.spin_once(0.002)

    def counted() -> dict[str, str]:
        return {v.key: v.value for d in client.diagnostics for s in d.status for v in s.values}

    names = [f"{topic.strip('/')}: not decodable" for topic in topics]

    def all_counted() -> bool:
        for publisher in publishers.values():  # the node may have found it after the first ones
            publisher.publish(b"\0\1\0\0")
        return set(names) <= counted().keys()

    client.spin_until(all_counted)

    assert client.call(Trigger, "/ins_node/reset", Trigger.Request()).success
    assert "internal error" not in counted()
    assert "a message of 4 bytes is not of the topic's type" in log.read_text()
    assert processes.stop(node) == 0
    assert "Traceback" not in log.read_text()


def test_publisher_whose_qos_does_not_fit_is_told(
    processes: Processes, folder: Path, client: Client
) -> None:
    """GIVEN imu/data asked for reliably WHEN it comes as best effort THEN the log says so."""
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import Imu

    log = folder / "unfit.log"
    start_node(processes, log, "-p", "qos_overrides./imu/data.subscription.reliability:=reliable")
    client.node.create_publisher(
        Imu, "/imu/data", QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    )

    until(lambda: "QoS" in log.read_text())
    told = next(line for line in log.read_text().splitlines() if "QoS" in line)
    assert "ERROR" in told
    assert "/imu/data" in told
    assert "RELIABILITY" in told
    assert "qos_overrides" in told

    client.spin_until(
        lambda: any(
            "no messages on /imu/data" in s.message for d in client.diagnostics for s in d.status
        )
    )


def test_publishers_of_another_type_are_told(
    processes: Processes, folder: Path, client: Client
) -> None:
    """GIVEN the TwistStamped of nmea_navsat_driver as velocity THEN the log names both types."""
    from geometry_msgs.msg import TwistStamped, TwistWithCovarianceStamped

    log = folder / "mistyped.log"
    start_node(processes, log, "-r", "gnss/velocity:=/vel")
    client.node.create_publisher(TwistStamped, "/vel", 10)
    client.node.create_publisher(TwistWithCovarianceStamped, "/aiding/velocity", 10)

    until(lambda: "geometry_msgs/msg/TwistStamped" in log.read_text())
    (told,) = (line for line in log.read_text().splitlines() if "TwistStamped" in line)
    assert "gnss/velocity: asking publishes geometry_msgs/msg/TwistStamped on /vel, not " in told
    client.spin_until(
        lambda: any(
            pair.key == "gnss/velocity: another type"
            for d in client.diagnostics
            for s in d.status
            for pair in s.values
        )
    )
    assert "aiding/velocity" not in log.read_text()


def ended_start(
    *words: str, environment: dict[str, str] | None = None, timeout: float = 90.0
) -> subprocess.CompletedProcess[str]:
    """Start a node that refuses its arguments, and wait for its end."""
    return subprocess.run(
        [sys.executable, "-m", "hybrid_ins.ros.node", *words],
        capture_output=True,
        text=True,
        timeout=timeout,
        env=os.environ | ENVIRONMENT | (environment or {}),
        check=False,
    )


def test_an_impossible_parameter_ends_the_start_with_one_line(tmp_path: Path) -> None:
    file = tmp_path / "bad.yaml"
    file.write_text("/**:\n  ros__parameters:\n    noise:\n      mode: clairvoyant\n")

    done = ended_start("--ros-args", "--params-file", str(file))

    assert done.returncode == 2
    assert "noise.mode" in done.stderr
    assert "Traceback" not in done.stderr


def test_all_impossible_parameters_are_named_at_once() -> None:
    """GIVEN values out of the range that ROS knows, and others WHEN started THEN all are named."""
    given = {
        "imu.max_gap": "-1.0",
        "gnss.patience": "-1",
        "noise.mode": "clairvoyant",
        "odometry_rate": "fast",
    }
    words = [word for name, value in given.items() for word in ("-p", f"{name}:={value}")]

    done = ended_start("--ros-args", *words)

    assert done.returncode == 2
    [line] = done.stderr.splitlines()
    assert all(f"parameter {name}: " in line for name in given)


def test_parameters_that_are_lost_are_named(processes: Processes, tmp_path: Path) -> None:
    """GIVEN a file for another namespace, and an empty list WHEN started THEN both are named."""
    file, log = tmp_path / "robot.yaml", tmp_path / "node.log"
    file.write_text("ins_node:\n  ros__parameters:\n    gnss: {patience: 5.0}\n")
    command = [sys.executable, "-m", "hybrid_ins.ros.node", "--params-file", str(file)]
    with log.open("w") as output:
        words = ["-r", "__ns:=/rover", "-p", "imu.position:=[]"]
        node = processes.start([*command, *words], output, ENVIRONMENT)

    assert node.wait(60.0) == 2
    assert "no section for /rover/ins_node, only for /ins_node: nothing in it" in log.read_text()
    assert "parameter imu.position: [] is not a list of 3 numbers" in log.read_text()


def test_parameter_files_mean_what_they_say(
    processes: Processes, tmp_path: Path, client: Client
) -> None:
    """GIVEN a list of mixed numbers, and no --ros-args WHEN started THEN both are understood."""
    from rcl_interfaces.srv import GetParameters

    file, log = tmp_path / "robot.yaml", tmp_path / "node.log"
    file.write_text("/**:\n  ros__parameters:\n    imu: {position: [0.1, 0, 0]}\n")
    command = [sys.executable, "-m", "hybrid_ins.ros.node", "--params-file", str(file)]
    with log.open("w") as output:
        processes.start([*command, "-p", "gnss.antenna_position:=[0, 0.5, 1]"], output, ENVIRONMENT)

    request = GetParameters.Request(names=["imu.position", "gnss.antenna_position"])
    values = client.call(GetParameters, "/ins_node/get_parameters", request, 60.0).values

    assert list(values[0].double_array_value) == [0.1, 0.0, 0.0]
    assert list(values[1].double_array_value) == [0.0, 0.5, 1.0]


@pytest.mark.parametrize(
    ("words", "environment", "complaint"),
    [
        (
            ["-p", "qos_overrides./imu/data.subscription.depth:=text"],
            {},
            "imu/data: .*depth' to 'text' .*: check qos_overrides",
        ),
        (["-r", "/a//b:=c"], {}, "Couldn't parse remap rule: '-r /a//b:=c'$"),
        (
            [],
            {"ROS_SECURITY_ENABLE": "true", "ROS_SECURITY_STRATEGY": "Enforce"},
            "enclaves' does not exist.$|security",
        ),
    ],
    ids=["QoS", "remap", "SROS 2"],
)
def test_what_ros_refuses_ends_the_start_with_one_line(
    words: list[str], environment: dict[str, str], complaint: str, tmp_path: Path
) -> None:
    (tmp_path / "enclaves").mkdir()
    secured = environment | {"ROS_SECURITY_KEYSTORE": str(tmp_path)}
    done = ended_start("--ros-args", *words, environment=secured, timeout=120.0)

    assert done.returncode == 2
    assert re.search(complaint, done.stderr, re.MULTILINE), done.stderr
    assert "Traceback" not in done.stderr and "internal error" not in done.stderr


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_the_first_compilation_is_ended_by_a_signal(
    processes: Processes, tmp_path: Path, number: signal.Signals
) -> None:
    cache, log = tmp_path / "cache", tmp_path / "node.log"
    node = start_node(
        processes, log, said="compiling the filter", environment={"NUMBA_CACHE_DIR": str(cache)}
    )

    node.send_signal(number)

    assert node.wait(60.0) == 0
    assert not list(cache.rglob("complete-*"))  # it ended before the compilation did
    assert "Traceback" not in log.read_text()


@pytest.mark.parametrize("word", ["robot.yaml", "--parms-file"])
def test_an_argument_that_is_none_of_ros_ends_the_start(word: str) -> None:
    done = ended_start(word)

    assert done.returncode == 2
    assert done.stderr.startswith("ins_node: error: unknown ROS arguments")
    assert word in done.stderr
