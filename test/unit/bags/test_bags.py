"""Recordings: written, read back by us and by others, broken in every way."""

import os
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as GeneralMcapWriter
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_typestore
from support.paths import ROOT

from hybrid_ins.bags import mcap_reader
from hybrid_ins.bags.messages import IMU, Message, new_message
from hybrid_ins.bags.reader import BagReader
from hybrid_ins.bags.writer import BagWriter
from hybrid_ins.errors import InputError

FIX = "sensor_msgs/msg/NavSatFix"
START_NS = 1_700_000_000_000_000_000
TYPES = get_typestore(Stores.ROS2_JAZZY)


def imu_message(k: int, frame_id: str = "imu_link") -> Message:
    message = new_message(IMU)
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns(k), 1_000_000_000)
    message.header.frame_id = frame_id
    message.linear_acceleration.x = 0.1 * k
    message.linear_acceleration.z = 9.8
    message.angular_velocity.y = -0.01 * k
    return message


def stamp_ns(k: int) -> int:
    return START_NS + 5_000_000 * k


def serialised(message: Message) -> bytes:
    return bytes(TYPES.serialize_cdr(message, message.__msgtype__))


def write_flight(path: Path, count: int = 2000) -> Path:
    """Write an Imu topic at 200 Hz with a fix at every 40th sample; several chunks."""
    with BagWriter(path) as bag:
        for k in range(count):
            bag.write("imu/data", imu_message(k), stamp_ns(k) + 1000)
            if k % 40 == 0:
                bag.write("/gnss/fix", new_message(FIX), stamp_ns(k) + 2000)
    return path


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_flight(tmp_path_factory.mktemp("flight") / "flight.mcap", 12_000)


# --- written and read back ------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["flight", "flight.mcap", "some/where/flight"])
def test_what_is_written_is_read_back(tmp_path: Path, name: str) -> None:
    with BagReader(write_flight(tmp_path / name)) as bag:
        assert bag.topics == {"/imu/data": IMU, "/gnss/fix": FIX}
        assert (bag.start_ns, bag.end_ns) == (stamp_ns(0) + 1000, stamp_ns(1999) + 1000)
        assert bag.count("imu/data") == bag.count("/imu/data") == 2000
        assert bag.count("/gnss/fix") == 50
        assert bag.count("/nothing") == 0
        messages = list(bag.messages())
        assert [m[0] for m in messages[:3]] == ["/imu/data", "/gnss/fix", "/imu/data"]
        assert [m[1] for m in messages] == sorted(m[1] for m in messages)
        assert [serialised(m) for _, _, m in bag.messages("imu/data")] == [
            serialised(imu_message(k)) for k in range(2000)
        ]
        assert list(bag.raw("/nothing")) == []


def test_other_readers_read_what_we_write(tmp_path: Path) -> None:
    directory = write_flight(tmp_path / "flight")
    with BagReader(directory) as ours:
        expected = list(ours.raw())
    for path in (directory, directory / "flight_0.mcap"):
        with AnyReader([path]) as theirs:
            found = [(c.topic, t, bytes(data)) for c, t, data in theirs.messages()]
            assert found == expected
            assert theirs.message_count == len(expected)
    with (directory / "flight_0.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        found = [(c.topic, m.log_time, m.data) for _, c, m in reader.iter_messages()]
        assert found == expected
        summary = reader.get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == len(expected)
    assert {s.encoding for s in summary.schemas.values()} == {"ros2msg"}


def test_messages_come_in_log_order_across_chunks(tmp_path: Path) -> None:
    order = list(range(9000))
    for start in range(0, 9000, 3000):  # each third is shuffled, and each begins in the one before
        part = order[max(0, start - 500) : start + 3000]
        random.Random(start).shuffle(part)
        order[max(0, start - 500) : start + 3000] = part
    with BagWriter(tmp_path / "bag.mcap") as bag:
        for k in order:
            bag.write("/imu/data", imu_message(k), stamp_ns(k))
    with BagReader(tmp_path / "bag.mcap") as bag:
        assert [t for _, t, _ in bag.raw()] == [stamp_ns(k) for k in range(9000)]


def test_a_split_recording_is_one_bag(tmp_path: Path) -> None:
    directory = tmp_path / "bag"
    directory.mkdir()
    for number, parity in enumerate((0, 1)):
        with BagWriter(directory / f"bag_{number}.mcap") as bag:
            for k in range(parity, 100, 2):
                bag.write("/imu/data", imu_message(k), stamp_ns(k))
    (directory / "metadata.yaml").write_text(
        "rosbag2_bagfile_information: {version: 9, storage_identifier: mcap,"
        " relative_file_paths: [bag_0.mcap, bag_1.mcap]}"
    )
    with BagReader(directory) as bag:
        assert [t for _, t, _ in bag.raw()] == [stamp_ns(k) for k in range(100)]
        assert bag.count("/imu/data") == 100
        assert (bag.start_ns, bag.end_ns) == (stamp_ns(0), stamp_ns(99))


@pytest.mark.parametrize("layout", ["sqlite3", "zstd chunks", "zstd messages", "zstd file"])
def test_recordings_of_rosbag2(tmp_path: Path, layout: str) -> None:
    plugin = StoragePlugin.SQLITE3 if layout == "sqlite3" else StoragePlugin.MCAP
    writer = Rosbag2Writer(tmp_path / "bag", version=9, storage_plugin=plugin)
    mode = {
        "zstd chunks": CompressionMode.STORAGE,
        "zstd messages": CompressionMode.MESSAGE,
        "zstd file": CompressionMode.FILE,
    }.get(layout, CompressionMode.NONE)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/imu/data", IMU, typestore=TYPES)
        for k in range(100):
            writer.write(connection, stamp_ns(k), serialised(imu_message(k)))
    with BagReader(tmp_path / "bag") as bag:
        assert bag.topics == {"/imu/data": IMU}
        assert (bag.start_ns, bag.end_ns) == (stamp_ns(0), stamp_ns(99))
        assert bag.count("/imu/data") == 100
        assert bag.imu().specific_force[:, 0] == pytest.approx(0.1 * np.arange(100))
    if layout == "sqlite3":
        with BagReader(tmp_path / "bag" / "bag.db3") as bag:
            assert bag.imu().stamp_ns[-1] == stamp_ns(99)


@pytest.mark.parametrize("options", [{"use_chunking": False}, {"compression": CompressionType.LZ4}])
def test_recordings_of_other_mcap_writers(tmp_path: Path, options: dict[str, object]) -> None:
    path = tmp_path / "bag.mcap"
    with path.open("wb") as file:
        writer = GeneralMcapWriter(file, **{"compression": CompressionType.NONE, **options})
        writer.start("ros2")
        text = TYPES.generate_msgdef(IMU, ros_version=2)[0].encode()
        schema = writer.register_schema(IMU, "ros2msg", text)
        channel = writer.register_channel("/imu/data", "cdr", schema)
        for k in reversed(range(100)):
            writer.add_message(channel, stamp_ns(k), serialised(imu_message(k)), stamp_ns(k))
        writer.finish()
    with BagReader(path) as bag:
        assert bag.count("/imu/data") == 100
        assert list(bag.imu().stamp_ns) == [stamp_ns(k) for k in range(100)]


def test_ros1_recordings(tmp_path: Path) -> None:
    types = get_typestore(Stores.ROS1_NOETIC)
    path = tmp_path / "robot.bag"
    with Ros1Writer(path) as writer:
        imu = writer.add_connection("/imu/data", IMU, typestore=types)
        own_type = writer.add_connection(
            "/own", "own_msgs/msg/Own", msgdef="uint8 x", md5sum="123456789"
        )
        for k in range(100):
            writer.write(imu, stamp_ns(k), TYPES.cdr_to_ros1(serialised(imu_message(k)), IMU))
            writer.write(own_type, stamp_ns(k), b"\0")
    with BagReader(path) as bag:
        assert bag.topics == {"/imu/data": IMU}
        assert (bag.start_ns, bag.end_ns) == (stamp_ns(0), stamp_ns(99))
        raw = [data for _, _, data in bag.raw("imu/data")]
        assert raw == [serialised(imu_message(k)) for k in range(100)]
        assert bag.imu().stamp_ns[-1] == stamp_ns(99)


def test_topics_that_nobody_can_decode_are_left_out(tmp_path: Path) -> None:
    with (tmp_path / "bag.mcap").open("wb") as file:
        writer = GeneralMcapWriter(file, compression=CompressionType.NONE)
        writer.start("ros2")
        schema = writer.register_schema("own_msgs/msg/Own", "ros2msg", b"this is no definition")
        imu = writer.register_schema(IMU, "ros2msg", b"")
        own = writer.register_channel("/own", "cdr", schema)
        text = writer.register_channel("/json", "json", 0)
        imu_channel = writer.register_channel("/imu/data", "cdr", imu)
        for channel, data in (
            (own, b"?"),
            (text, b"{}"),
            (imu_channel, serialised(imu_message(0))),
        ):
            writer.add_message(channel, stamp_ns(0), data, stamp_ns(0))
        writer.finish()
    with BagReader(tmp_path / "bag.mcap") as bag:
        assert bag.topics == {"/imu/data": IMU}
        assert [topic for topic, _, _ in bag.messages()] == ["/imu/data"]


@pytest.mark.parametrize(
    "type_name",
    ["nav_msgs/msg/Odometry", "diagnostic_msgs/msg/DiagnosticArray", "tf2_msgs/msg/TFMessage"],
)
def test_a_new_message_is_zero_and_complete(type_name: str) -> None:
    data = serialised(new_message(type_name))
    assert set(data[4:]) <= {0, 1}  # an empty text has length 1
    assert bytes(TYPES.serialize_cdr(TYPES.deserialize_cdr(data, type_name), type_name)) == data


# --- Imu in bulk ----------------------------------------------------------------------------------


def big_endian(message: Message) -> bytes:
    return bytes(TYPES.serialize_cdr(message, IMU, little_endian=False))


@pytest.mark.parametrize(
    "encode",
    [
        lambda k: serialised(imu_message(k)),
        lambda k: serialised(imu_message(k, "imu" * (k % 3))),
        lambda k: (big_endian if k % 2 else serialised)(imu_message(k)),
    ],
    ids=["one layout", "frame_id changes", "byte order changes"],
)
def test_imu_table(tmp_path: Path, encode: Callable[[int], bytes]) -> None:
    with BagWriter(tmp_path / "bag.mcap") as bag:
        for k in range(50):
            bag.write_raw("/imu/data", IMU, encode(k), stamp_ns(k) + 7)
    with BagReader(tmp_path / "bag.mcap") as bag:
        table = bag.imu("imu/data")
    k = np.arange(50)
    np.testing.assert_array_equal(table.stamp_ns, stamp_ns(0) + 5_000_000 * k)
    np.testing.assert_array_equal(table.log_ns, table.stamp_ns + 7)
    np.testing.assert_array_equal(table.specific_force, np.c_[0.1 * k, 0 * k, 9.8 + 0 * k])
    np.testing.assert_array_equal(table.angular_rate, np.c_[0 * k, -0.01 * k, 0 * k])
    assert table.stamp_ns.dtype == table.log_ns.dtype == np.int64


def test_ten_minutes_at_200_hz_are_read_whole(tmp_path: Path) -> None:
    data = serialised(imu_message(1))
    with BagWriter(tmp_path / "bag.mcap") as bag:
        for k in range(120_000):
            bag.write_raw("/imu/data", IMU, data, stamp_ns(k))
    with BagReader(tmp_path / "bag.mcap") as bag:
        table = bag.imu()
    np.testing.assert_array_equal(table.log_ns, [stamp_ns(k) for k in range(120_000)])


# --- errors that the user can act on --------------------------------------------------------------


def test_a_missing_topic_names_those_that_would_do(flight: Path) -> None:
    with BagReader(flight) as bag:
        with pytest.raises(InputError, match=r"no topic /imu: choose /imu/data with --imu-topic"):
            bag.imu("imu")
        with pytest.raises(InputError, match=r"/gnss/fix is .*NavSatFix, not .*Imu: choose /imu"):
            bag.imu("/gnss/fix")
        with pytest.raises(InputError, match=r"no other is std_msgs/msg/Bool; it has /gnss/fix, "):
            bag.require("/x", "std_msgs/msg/Bool", "--x")


def test_the_map_s_origin_and_the_truth_would_not_do(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as out:
        for topic in ("/truth/datum", "/datum"):
            out.write(topic, new_message("sensor_msgs/msg/NavSatFix"), 1)

    with BagReader(tmp_path / "bag") as bag, pytest.raises(InputError, match=r"no other is .*Fix"):
        bag.require("/gnss/fix", "sensor_msgs/msg/NavSatFix", "--fix-topic")


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"", "is empty"),
        (b"time,x,y,z\n0,1,2,3\n", "is not a bag"),
        (b"\x89MCAP0\r\n", "breaks off at byte 8 before the first whole message"),
        (b"SQLite format 3\0" + bytes(500), "cannot be read"),
        (b"#ROSBAG V2.0\n" + bytes(500), "cannot be read"),
        (b"#ROSBAG V1.2\n", "version 102 is not supported"),
    ],
)
def test_files_that_are_no_bag(tmp_path: Path, content: bytes, complaint: str) -> None:
    path = tmp_path / "bag.db3"
    path.write_bytes(content)
    with pytest.raises(InputError, match=complaint) as caught:
        BagReader(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_paths_that_are_no_bag(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        BagReader(tmp_path / "nothing")
    with pytest.raises(InputError, match=r"no metadata\.yaml"):
        BagReader(tmp_path)
    with pytest.raises(InputError, match="neither a file nor a directory"):
        BagReader("/dev/null")
    with BagWriter(tmp_path / "empty.mcap"):
        pass
    with pytest.raises(InputError, match="holds no messages"):
        BagReader(tmp_path / "empty.mcap")


METADATA_DAMAGE = {
    "gone": None,
    "no yaml": b"\x00\xff{",
    "nested": b"[" * 100_000,
    "other yaml": b"[1, 2]",
    "no files": b"rosbag2_bagfile_information: {relative_file_paths: []}",
    "aliases": b"rosbag2_bagfile_information: &a {b: *a}",
    "huge": b"#" * (2 << 20),
}


@pytest.mark.parametrize("damage", METADATA_DAMAGE.values(), ids=METADATA_DAMAGE)
def test_damaged_metadata_does_not_hide_the_data(
    tmp_path: Path, damage: bytes | None, caplog: pytest.LogCaptureFixture
) -> None:
    path = write_flight(tmp_path / "bag", 100) / "metadata.yaml"
    path.unlink() if damage is None else path.write_bytes(damage)
    with BagReader(tmp_path / "bag") as bag:
        assert bag.count("/imu/data") == 100
    assert "metadata.yaml" in caplog.text


def test_a_missing_part_is_named(tmp_path: Path) -> None:
    (write_flight(tmp_path / "bag", 100) / "bag_0.mcap").unlink()
    with pytest.raises(InputError, match=r"lacks bag_0\.mcap: copy the whole bag"):
        BagReader(tmp_path / "bag")


def test_a_damaged_message_is_named(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag.mcap") as bag:
        bag.write_raw("/imu/data", IMU, serialised(imu_message(0))[:-8], stamp_ns(0))
    with BagReader(tmp_path / "bag.mcap") as bag:
        with pytest.raises(InputError, match=f"message on /imu/data at {stamp_ns(0)} ns is no"):
            list(bag.messages())
        with pytest.raises(InputError, match="is no sensor_msgs/msg/Imu"):
            bag.imu()


# --- recordings that break off --------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.3, 0.5, 0.9, 0.9999])
def test_a_truncated_file_is_read_up_to_the_break(
    tmp_path: Path, flight: Path, share: float, caplog: pytest.LogCaptureFixture
) -> None:
    whole = flight.read_bytes()
    path = tmp_path / "cut.mcap"
    path.write_bytes(whole[: int(share * len(whole))])
    with BagReader(flight) as bag:
        expected = list(bag.raw())
    with BagReader(path) as bag:
        found = list(bag.raw())
        assert bag.count("/imu/data") == sum(m[0] == "/imu/data" for m in found)
        assert bag.end_ns == found[-1][1]
    assert found == expected[: len(found)]
    assert len(found) > (share - 0.25) * len(expected)
    assert ("breaks off at byte" if share < 0.99 else "no usable index") in caplog.text
    assert f"{path}: the recording" in caplog.text


def test_a_file_cut_before_its_first_chunk_ends_is_refused(tmp_path: Path, flight: Path) -> None:
    path = tmp_path / "cut.mcap"
    path.write_bytes(flight.read_bytes()[:5000])
    with pytest.raises(InputError, match="before the first whole message"):
        BagReader(path)


def mutate(data: bytes, seed: int) -> bytes:
    """Flip bits, overwrite, cut out or insert a stretch, or cut the end off."""
    rng = random.Random(seed)
    mutant = bytearray(data)
    at = rng.choice((rng.randrange(len(data)), rng.randrange(300), -rng.randrange(1, 2000)))
    length = rng.choice((1, 4, 8, 100, 5000))
    match seed % 5:
        case 0:
            mutant[at] ^= 1 << rng.randrange(8)
        case 1:
            mutant[at : at + length or None] = rng.randbytes(length)
        case 2:
            del mutant[at : at + length]
        case 3:
            mutant[at:at] = rng.choice((bytes(length), b"\xff" * length))
        case 4:
            del mutant[at:]
    return bytes(mutant)


def make_sqlite3(path: Path) -> Path:
    with Rosbag2Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection("/imu/data", IMU, typestore=TYPES)
        for k in range(200):
            writer.write(connection, stamp_ns(k), serialised(imu_message(k)))
    return path / f"{path.name}.db3"


def make_ros1(path: Path) -> Path:
    path = path.with_suffix(".bag")
    with Ros1Writer(path) as writer:
        connection = writer.add_connection(
            "/imu/data", IMU, typestore=get_typestore(Stores.ROS1_NOETIC)
        )
        for k in range(200):
            data = TYPES.cdr_to_ros1(serialised(imu_message(k)), IMU)
            writer.write(connection, stamp_ns(k), data)
    return path


def complaint_about(path: Path) -> str:
    """Read all of a bag; return why it is refused."""
    try:
        with BagReader(path) as bag:
            for _ in bag.messages():
                pass
            bag.imu()
    except InputError as error:
        return str(error)
    return ""


@pytest.mark.parametrize(
    "make", [lambda p: write_flight(p / "x.mcap", 200), make_sqlite3, make_ros1]
)
def test_mutated_files_are_read_or_refused(
    tmp_path: Path, make: Callable[[Path], Path], caplog: pytest.LogCaptureFixture
) -> None:
    original = make(tmp_path / "original")
    data = original.read_bytes()
    mutant = tmp_path / f"mutant{original.suffix}"
    noticed = 0
    for seed in range(300):
        mutant.write_bytes(mutate(data, seed))
        caplog.clear()
        complaint = complaint_about(mutant)
        noticed += bool(complaint or caplog.records)
        if complaint:
            assert str(mutant) in complaint
            assert "\n" not in complaint
    assert noticed > 20


def missing_seconds(text: str) -> tuple[float, float]:
    begin, end = re.findall(r"messages from ([\d.]+) to ([\d.]+) s are missing", text)[0]
    return float(begin), float(end)


@pytest.mark.parametrize("complete", [True, False], ids=["complete", "cut off"])
def test_a_damaged_chunk_is_skipped_and_its_seconds_named(
    tmp_path: Path, flight: Path, complete: bool, caplog: pytest.LogCaptureFixture
) -> None:
    """GIVEN a flipped bit in the middle WHEN read THEN all but one chunk's seconds are there."""
    data = bytearray(flight.read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "bag.mcap").write_bytes(data if complete else data[: -len(data) // 5])
    with BagReader(flight) as bag:
        expected = list(bag.raw())
        start_ns = bag.start_ns

    with BagReader(tmp_path / "bag.mcap") as bag:
        found = list(bag.raw())
        table = bag.imu()

    assert caplog.text.count("are missing") == 1
    assert "a chunk fails its checksum" in caplog.text
    begin, end = missing_seconds(caplog.text)
    assert 0.0 < begin < end < begin + 5.0
    there = set(found)
    missing = [m for m in expected if m[1] <= found[-1][1] and m not in there]
    gone = set(missing)
    assert found == [m for m in expected[: len(found) + len(missing)] if m not in gone]
    seconds = [(log_ns - start_ns) * 1e-9 for _, log_ns, _ in missing]
    assert (min(seconds), max(seconds)) == pytest.approx((begin, end), abs=0.006)
    assert len(table.stamp_ns) == sum(message[0] == "/imu/data" for message in found)


def test_a_bag_of_which_nothing_can_be_read_is_refused(tmp_path: Path) -> None:
    path = write_flight(tmp_path / "bag.mcap", 100)
    data = bytearray(path.read_bytes())
    data[10_000] ^= 1
    path.write_bytes(data)
    with BagReader(path) as bag, pytest.raises(InputError, match="no message on /imu/data can be"):
        bag.imu()


def test_a_damaged_message_index_costs_nothing(tmp_path: Path, flight: Path) -> None:
    """The index of the first chunk points elsewhere, or names another channel."""
    data = bytearray(flight.read_bytes())
    with flight.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    for offset in summary.chunk_indexes[0].message_index_offsets.values():
        data[offset + 15 + 8] ^= 1  # where the first message is
    (tmp_path / "bag.mcap").write_bytes(data)
    with BagReader(flight) as whole, BagReader(tmp_path / "bag.mcap") as bag:
        assert list(bag.raw()) == list(whole.raw())


MEMORY = """
import resource, sys
from hybrid_ins.bags.reader import BagReader
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
with BagReader(sys.argv[1]) as bag:
    print(sum(1 for _ in bag.raw()), end=" ")
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024)
"""


@pytest.mark.parametrize("index", [True, False], ids=["indexed", "without index"])
def test_a_small_file_of_a_huge_chunk_takes_bounded_memory(tmp_path: Path, index: bool) -> None:
    """GIVEN 12 kB that become four million messages WHEN read THEN it takes a few times them."""
    size = 4_000_000
    path = tmp_path / "bomb.mcap"
    with path.open("wb") as file:
        kinds = IndexType.ALL if index else IndexType.CHUNK
        writer = GeneralMcapWriter(file, chunk_size=1 << 40, index_types=kinds)
        writer.start("ros2")
        schema = writer.register_schema(IMU, "ros2msg", b"")
        channel = writer.register_channel("/imu/data", "cdr", schema)
        writer.add_message(channel, 0, b"\0", 0)
        builder = writer._Writer__chunk_builder  # type: ignore[attr-defined]
        message = builder.record_writer._buffer.getvalue()[-32:]
        builder.record_writer.write(message * (size - 1))
        if index:
            entries = builder.message_indices[channel].records
            entries += [(0, entries[0][1] + 32 * k) for k in range(1, size)]
        writer.finish()
    count, megabytes = subprocess.run(
        [sys.executable, "-c", MEMORY, str(path)],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    ).stdout.split()
    assert int(count) == size
    assert int(megabytes) < 800  # 1600 with an object for each message


def test_a_chunk_that_claims_too_much_is_skipped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    path = write_flight(tmp_path / "bag.mcap", 2000)
    monkeypatch.setattr(mcap_reader, "LARGEST_CHUNK", 200_000)
    with BagReader(path) as bag:
        assert 0 < len(bag.imu().stamp_ns) < 2000
    assert "more than 200000" in caplog.text


def test_overlapping_chunks_of_different_topics_are_merged(tmp_path: Path) -> None:
    """Each topic's chunks follow each other; those of the topics overlap."""
    path = tmp_path / "bag.mcap"
    with path.open("wb") as file:
        writer = GeneralMcapWriter(file, chunk_size=1 << 40)
        writer.start("ros2")
        for topic in ("/a", "/b"):
            schema = writer.register_schema(IMU, "ros2msg", b"")
            channel = writer.register_channel(topic, "cdr", schema)
            for start in (0, 50):
                for k in range(start, start + 50):
                    writer.add_message(channel, k, serialised(imu_message(k)), k)
                writer.flush()
        writer.finish()
    with BagReader(path) as bag:
        order = [(t, topic) for topic, t, _ in bag.raw()]
    assert order == [(k, topic) for k in range(100) for topic in ("/a", "/b")]


# --- topics ---------------------------------------------------------------------------------------


def test_topics_without_a_leading_slash(tmp_path: Path) -> None:
    path = tmp_path / "bag.mcap"
    with path.open("wb") as file:
        writer = GeneralMcapWriter(file)
        writer.start("ros2")
        schema = writer.register_schema(IMU, "ros2msg", b"")
        channel = writer.register_channel("imu/data", "cdr", schema)
        writer.add_message(channel, 1, serialised(imu_message(1)), 1)
        writer.finish()
    with BagReader(path) as bag:
        assert bag.topics == {"/imu/data": IMU}
        assert len(bag.imu().stamp_ns) == len(bag.imu("imu/data").stamp_ns) == 1


def test_the_only_topic_of_a_type_is_taken(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with BagWriter(tmp_path / "bag") as out:
        out.write("/sensors/imu", imu_message(1), 1)
    with BagReader(tmp_path / "bag") as bag:
        assert len(bag.imu().stamp_ns) == 1
        assert "no topic /imu/data: reading /sensors/imu, the only" in caplog.text
        with pytest.raises(InputError, match="no topic /imu: choose /sensors/imu"):
            bag.imu("/imu")  # somebody meant another
    with BagWriter(tmp_path / "two") as out:
        for topic in ("/imu1", "/imu2"):
            out.write(topic, imu_message(1), 1)
    two = BagReader(tmp_path / "two")
    with two, pytest.raises(InputError, match="choose /imu1 or /imu2 with --imu-topic"):
        two.imu()


def test_players_offer_the_map_s_origin_to_late_subscribers(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as out:
        for topic in ("/datum", "/gnss/fix"):
            out.write(topic, new_message(FIX), 1)
    for path in (tmp_path / "bag", tmp_path / "bag" / "bag_0.mcap"):
        with AnyReader([path]) as reader:
            durability = {
                c.topic: [
                    (q.durability.name, q.reliability.name) for q in c.ext.offered_qos_profiles
                ]
                for c in reader.connections
            }
        assert durability == {
            "/datum": [("TRANSIENT_LOCAL", "RELIABLE")],
            "/gnss/fix": [("VOLATILE", "RELIABLE")],
        }


# --- an interrupted or misdirected writer ---------------------------------------------------------


@pytest.mark.parametrize("name", ["bag", "bag.mcap"])
@pytest.mark.parametrize("interruption", [KeyboardInterrupt, RuntimeError])
def test_an_interrupted_bag_holds_everything_so_far(
    tmp_path: Path,
    name: str,
    interruption: type[BaseException],
    caplog: pytest.LogCaptureFixture,
) -> None:
    def record() -> None:
        with BagWriter(tmp_path / name) as bag:
            for k in range(5000):
                bag.write("/imu/data", imu_message(k), stamp_ns(k))
            raise interruption

    with pytest.raises(interruption):
        record()
    assert "ends early, after 5000 messages (25.0 s)" in caplog.text
    caplog.clear()
    with BagReader(tmp_path / name) as bag:
        assert bag.imu().stamp_ns[-1] == stamp_ns(4999)
    assert not caplog.text


@pytest.mark.parametrize("name", ["bag", "bag.mcap"])
def test_failing_before_the_first_message_leaves_nothing(tmp_path: Path, name: str) -> None:
    with pytest.raises(RuntimeError), BagWriter(tmp_path / name):
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_at_any_moment_leaves_a_whole_bag(tmp_path: Path) -> None:
    """The signal arrives while messages are serialised, gathered and flushed."""
    script = tmp_path / "record.py"
    script.write_text(
        "import sys\n"
        "from hybrid_ins.bags.writer import BagWriter\n"
        "with BagWriter(sys.argv[1]) as bag:\n"
        "    print('started', flush=True)\n"
        "    for k in range(10**9):\n"
        "        bag.write_raw('/imu/data', 'sensor_msgs/msg/Imu', bytes(20_000), k)\n"
    )
    for k in range(5):
        path = tmp_path / f"bag{k}.mcap"
        with subprocess.Popen(
            [sys.executable, str(script), str(path)],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        ) as process:
            assert process.stdout is not None
            process.stdout.readline()
            time.sleep(0.05 + 0.013 * k)
            process.send_signal(signal.SIGINT)
            process.wait(20)
        assert process.returncode
        with path.open("rb") as file:
            times = [m.log_time for _, _, m in make_reader(file, True).iter_messages()]
        assert times == list(range(len(times)))
        assert times


def test_a_killed_writer_loses_only_its_last_chunk(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    writer = BagWriter(tmp_path / "bag")
    for k in range(10_000):
        writer.write("/imu/data", imu_message(k), stamp_ns(k))
    with BagReader(tmp_path / "bag") as bag:
        count = len(bag.imu().stamp_ns)
    assert 6000 < count < 10_000
    assert "not completed: no metadata.yaml" in caplog.text
    assert "breaks off" in caplog.text
    writer.close()


def test_nothing_is_overwritten_unasked(tmp_path: Path) -> None:
    path = write_flight(tmp_path / "bag", 100)
    with pytest.raises(InputError, match="exists: give another name, or --overwrite"):
        BagWriter(path)
    with BagWriter(path, overwrite=True) as bag:
        bag.write("/imu/data", imu_message(0), stamp_ns(0))
    with BagReader(path) as bag:
        assert bag.count("/imu/data") == 1
    (path / "thesis.tex").write_text("years of work")
    with pytest.raises(InputError, match=r"more than a bag \(thesis\.tex\): not overwritten"):
        BagWriter(path, overwrite=True)


def test_a_full_disk_is_one_clear_line(tmp_path: Path) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("this system has no /dev/full")
    bag = BagWriter(tmp_path / "bag.mcap")
    bag._writer._file = open("/dev/full", "wb", buffering=0)  # noqa: PTH123, SIM115
    bag.write("/imu/data", imu_message(0), stamp_ns(0))
    with pytest.raises(InputError, match="cannot be written: No space left on device"):
        bag.close()


def test_misuse_of_the_writer(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag.mcap") as bag:
        bag.write("/imu/data", imu_message(0), stamp_ns(0))
        with pytest.raises(ValueError, match=r"/imu/data holds .*Imu, not .*NavSatFix"):
            bag.write("imu/data", new_message(FIX), stamp_ns(0))
        with pytest.raises(ValueError, match="no standard message type"):
            bag.write_raw("/own", "own_msgs/msg/Own", b"", stamp_ns(0))
        with pytest.raises(ValueError, match="before the epoch"):
            bag.write("/imu/data", imu_message(0), -1)
    with BagReader(tmp_path / "bag.mcap") as reader:
        assert reader.count("/imu/data") == 1
