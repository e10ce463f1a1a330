"""Other people's tools read our recordings, and we read theirs."""

import json
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.typesys import Stores, get_typestore

from hybrid_ins.bags.reader import BagReader
from hybrid_ins.cli import evaluate, replay, simulate

DURATION = 20.0
FLIGHT = ["--duration", str(DURATION), "--imu-rate", "200", "--heading", "0", "--seed", "4"]
ALIGNED_AT_ONCE = [
    *("-p", "alignment.heading_source:=parameter"),
    *("-p", "alignment.yaw:=1.5708"),  # the simulated nose points north
]


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    bag = tmp_path_factory.mktemp("interoperability") / "flight"
    assert simulate.main([str(bag), *FLIGHT]) == 0
    return bag


@pytest.fixture(scope="module")
def estimate(flight: Path) -> Path:
    bag = flight.with_name("estimate")
    assert replay.main([str(flight), str(bag), *ALIGNED_AT_ONCE]) == 0
    return bag


def score(bag: Path, capsys: pytest.CaptureFixture[str]) -> dict[str, object]:
    capsys.readouterr()
    assert evaluate.main([str(bag), "--json", "--include-fed"]) == 0
    return dict(json.loads(capsys.readouterr().out))


def track(bag: Path, topic: str) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (N,) [ns] and positions (N, 3) [m], by the `rosbags` reader."""
    stamps, positions = [], []
    with AnyReader([bag]) as reader:
        connections = [c for c in reader.connections if c.topic == topic]
        for connection, _, data in reader.messages(connections):
            message = reader.deserialize(data, connection.msgtype)
            stamp, p = message.header.stamp, message.pose.pose.position
            stamps.append(stamp.sec * 1_000_000_000 + stamp.nanosec)
            positions.append((p.x, p.y, p.z))
    return np.array(stamps), np.array(positions)


def counts(bag: Path) -> Counter[str]:
    with BagReader(bag) as reader:
        return Counter({topic: reader.count(topic) for topic in reader.topics})


@pytest.mark.slow
def test_rosbags_reads_what_ins_replay_writes_and_agrees_with_ins_evaluate(
    estimate: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth_ns, truth = track(estimate, "/truth/odometry")
    here_ns, here = track(estimate, "/odometry")
    _, i, j = np.intersect1d(truth_ns, here_ns, return_indices=True)
    rmse = float(np.sqrt(np.mean(np.sum((truth[i] - here[j]) ** 2, axis=1))))

    result = score(estimate, capsys)

    assert len(i) == result["epochs"]["scored"]  # type: ignore[index]
    assert rmse == pytest.approx(result["prmse_m"], rel=1e-9)


@pytest.mark.slow
def test_evo_agrees_with_ins_evaluate(
    estimate: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    evo = shutil.which("evo_ape", path=str(Path(sys.executable).parent)) or shutil.which("evo_ape")
    if evo is None:
        pytest.skip("no evo, which has no rosdep key: pip install evo")
    result = tmp_path / "ape.zip"
    tracks = [str(estimate), "/truth/odometry", "/odometry"]
    options = ["--t_max_diff", "0.001", "--save_results", str(result)]
    home = {"HOME": str(tmp_path), "PATH": ""}
    subprocess.run([evo, "bag2", *tracks, *options], check=True, env=home, timeout=120)
    shutil.unpack_archive(result, tmp_path)

    rmse = json.loads((tmp_path / "stats.json").read_text())["rmse"]

    assert rmse == pytest.approx(score(estimate, capsys)["prmse_m"], rel=1e-6)


def test_mcap_library_reads_every_message(estimate: Path) -> None:
    found: Counter[str] = Counter()
    with next(estimate.glob("*.mcap")).open("rb") as file:
        for schema, channel, _ in make_reader(file).iter_messages():
            assert schema is not None
            assert schema.encoding == "ros2msg"
            found[channel.topic] += 1

    assert found == counts(estimate)


@pytest.mark.parametrize("options", [["--dst-storage", "sqlite3"], ["--compress", "zstd"]])
def test_rosbags_convert_takes_the_bag_and_we_take_the_result(
    estimate: Path, tmp_path: Path, options: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    if options[0] == "--compress":
        options = [*options, "--compress-mode", "storage", "--dst-storage", "mcap"]
    convert(estimate, tmp_path / "converted", *options)

    assert counts(tmp_path / "converted") == counts(estimate)
    assert score(tmp_path / "converted", capsys)["prmse_m"] == score(estimate, capsys)["prmse_m"]


def convert(source: Path, target: Path, *options: str) -> None:
    program = Path(sys.executable).with_name("rosbags-convert")
    command = [program, "--src", source, "--dst", target, *options]
    subprocess.run([str(word) for word in command], check=True, timeout=120)


@pytest.mark.slow
def test_bag_of_ros_1_replays_like_the_one_of_ros_2(
    flight: Path, estimate: Path, tmp_path: Path
) -> None:
    bag = tmp_path / "ros1.bag"
    write_ros1(flight, bag, {"/imu/data": "/sensors/imu", "/gnss/fix": "/sensors/fix"})
    out = tmp_path / "out"
    topics = ["--imu-topic", "/sensors/imu", "--fix-topic", "/sensors/fix"]

    assert replay.main([str(bag), str(out), *topics, *ALIGNED_AT_ONCE]) == 0

    for ours, theirs in zip(track(estimate, "/odometry"), track(out, "/odometry"), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def write_ros1(source: Path, target: Path, names: dict[str, str]) -> None:
    """Write some topics under other names as a ROS 1 recorder would."""
    types = get_typestore(Stores.ROS1_NOETIC)
    with AnyReader([source]) as reader, Ros1Writer(target) as writer:
        wanted = [c for c in reader.connections if c.topic in names]
        channels = {
            c.topic: writer.add_connection(names[c.topic], c.msgtype, typestore=types)
            for c in wanted
        }
        for sequence, (connection, log_ns, data) in enumerate(reader.messages(wanted)):
            message = reader.deserialize(data, connection.msgtype)
            header = types.types["std_msgs/msg/Header"](
                sequence, message.header.stamp, message.header.frame_id
            )
            message.header = header
            writer.write(
                channels[connection.topic],
                log_ns,
                types.serialize_ros1(message, connection.msgtype),
            )
