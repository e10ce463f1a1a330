"""Recordings written and read back, by us and by others."""

import errno
import random
import sqlite3
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as GeneralMcapWriter
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_typestore
from support.bags import FIX, TYPES, imu_message, serialised, stamp_ns, write_flight

from hybrid_ins.bags import reader
from hybrid_ins.bags.mcap_reader import MAGIC
from hybrid_ins.bags.messages import Message, new_message
from hybrid_ins.bags.reader import BagReader
from hybrid_ins.bags.writer import BagWriter
from hybrid_ins.errors import InputError
from hybrid_ins.ros.messages.type_names import IMU
from hybrid_ins.row_file import BlockFile


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


@pytest.mark.parametrize("last", [b"", MAGIC], ids=["empty", "cut off"])
def test_a_split_recording_is_read_without_a_file_that_cannot_be(
    tmp_path: Path, last: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    """GIVEN a computer that was switched off while the recorder began another file."""
    directory = tmp_path / "bag"
    directory.mkdir()
    with BagWriter(directory / "bag_0.mcap") as bag:
        for k in range(100):
            bag.write("/imu/data", imu_message(k), stamp_ns(k))
    (directory / "bag_1.mcap").write_bytes(last)

    with BagReader(directory) as bag:
        assert bag.count("/imu/data") == 100
    assert "bag_1.mcap" in caplog.text and "other files are read" in caplog.text

    (directory / "bag_0.mcap").write_bytes(b"")
    with pytest.raises(InputError, match=r"bag_0\.mcap: is empty"):
        BagReader(directory)


def recording(path: Path, mode: CompressionMode, plugin: StoragePlugin) -> Path:
    """Write a hundred Imu messages as `rosbags` does."""
    writer = Rosbag2Writer(path, version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/imu/data", IMU, typestore=TYPES)
        for k in range(100):
            writer.write(connection, stamp_ns(k), serialised(imu_message(k)))
    return path


@pytest.mark.parametrize("layout", ["sqlite3", "zstd chunks", "zstd messages", "zstd file"])
def test_recordings_of_rosbag2(tmp_path: Path, layout: str) -> None:
    plugin = StoragePlugin.SQLITE3 if layout == "sqlite3" else StoragePlugin.MCAP
    mode = {
        "zstd chunks": CompressionMode.STORAGE,
        "zstd messages": CompressionMode.MESSAGE,
        "zstd file": CompressionMode.FILE,
    }.get(layout, CompressionMode.NONE)
    with BagReader(recording(tmp_path / "bag", mode, plugin)) as bag:
        assert bag.topics == {"/imu/data": IMU}
        assert (bag.start_ns, bag.end_ns) == (stamp_ns(0), stamp_ns(99))
        assert bag.count("/imu/data") == 100
        assert bag.imu().specific_force[:, 0] == pytest.approx(0.1 * np.arange(100))
    if layout == "sqlite3":
        with BagReader(tmp_path / "bag" / "bag.db3") as bag:
            assert bag.imu().stamp_ns[-1] == stamp_ns(99)


def test_compressed_messages_are_read_without_metadata(tmp_path: Path) -> None:
    folder = recording(tmp_path / "bag", CompressionMode.MESSAGE, StoragePlugin.MCAP)
    (folder / "metadata.yaml").unlink()

    with BagReader(folder) as bag:
        assert bag.imu().specific_force[:, 0] == pytest.approx(0.1 * np.arange(100))


def test_compressed_files_without_metadata_are_named(tmp_path: Path) -> None:
    folder = recording(tmp_path / "bag", CompressionMode.FILE, StoragePlugin.MCAP)
    (folder / "metadata.yaml").unlink()

    with pytest.raises(InputError, match=r"no metadata.yaml, .* unzstd bag\.mcap\.zstd"):
        BagReader(folder)


def test_too_little_room_to_decompress_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = recording(tmp_path / "bag", CompressionMode.FILE, StoragePlugin.SQLITE3)

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(tempfile.TemporaryDirectory, "__init__", full)
    monkeypatch.setattr(tempfile.TemporaryDirectory, "__del__", lambda self: None, raising=False)
    with pytest.raises(InputError, match=r"No space left on device.*set TMPDIR"):
        BagReader(folder)


def test_messages_in_the_log_of_an_sqlite_database_are_missed(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = recording(tmp_path / "bag", CompressionMode.NONE, StoragePlugin.SQLITE3)
    database = sqlite3.connect(folder / "bag.db3")
    database.execute("PRAGMA journal_mode=WAL")
    database.execute("DELETE FROM messages WHERE timestamp < ?", (stamp_ns(50),))
    database.commit()

    with BagReader(folder) as bag:
        assert bag.count("/imu/data") == 100  # without what the log says
    database.close()
    assert "messages in bag.db3-wal are not read" in caplog.text


def test_a_path_that_sqlite_misreads_is_named(tmp_path: Path) -> None:
    folder = recording(tmp_path / "bag", CompressionMode.NONE, StoragePlugin.SQLITE3)
    folder = folder.rename(tmp_path / "run#3")

    with pytest.raises(InputError, match=r"whose path holds .*: rename it"):
        BagReader(folder)


@pytest.mark.parametrize(
    "options",
    [
        {"use_chunking": False},
        {"compression": CompressionType.LZ4},
        {"repeat_channels": False},
        {"repeat_schemas": False},
    ],
)
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


def test_imu_table_of_many_blocks_is_that_of_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with BagWriter(tmp_path / "bag.mcap") as bag:
        for k in range(50):
            name = "imu_a" if k < 20 else "imu_b"
            bag.write_raw("/imu/data", IMU, serialised(imu_message(k, name)), stamp_ns(k))
    with BagReader(tmp_path / "bag.mcap") as bag:
        whole = bag.imu()
        monkeypatch.setattr(reader, "IMU_BLOCK", 8)
        blocks = bag.imu()
    assert whole.frames == blocks.frames == ((0, "imu_a"), (20, "imu_b"))
    np.testing.assert_array_equal(whole.stamp_ns, blocks.stamp_ns)
    np.testing.assert_array_equal(whole.specific_force, blocks.specific_force)


def test_imu_table_in_a_file_is_that_in_memory(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reader, "IMU_BLOCK", 7)
    with BagReader(flight) as bag:
        in_memory = bag.imu()
        in_file = bag.imu(make_blocks=lambda: BlockFile(tmp_path))
    assert in_file.frames == in_memory.frames
    for name in ("stamp_ns", "log_ns", "specific_force", "orientation_xyzw", "has_reading"):
        assert np.array_equal(getattr(in_file, name), getattr(in_memory, name))
        assert isinstance(getattr(in_file, name).base, np.memmap)
    assert not list(tmp_path.iterdir())  # it has no name


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
        with pytest.raises(InputError, match=f"message on /imu/data at {stamp_ns(0)} ns is not"):
            list(bag.messages())
        with pytest.raises(InputError, match="is not a sensor_msgs/msg/Imu"):
            bag.imu()


def test_damaged_messages_among_sound_ones_are_left_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """
    GIVEN a bag in which a few messages are not of their topic's type
    WHEN it is read, message by message and as a table
    THEN all others are there, and one line for each topic says that some are not.
    """
    with BagWriter(tmp_path / "bag.mcap") as bag:
        for k in range(100):
            data = serialised(imu_message(k, "imu_link" if k < 50 else "other"))
            bag.write_raw("/imu/data", IMU, data, stamp_ns(k))
            bag.write_raw("/gnss/fix", FIX, serialised(new_message(FIX)), stamp_ns(k))
            if k % 10 == 5:
                bag.write_raw("/imu/data", IMU, b"\0\1\0\0", stamp_ns(k))
                bag.write_raw("/gnss/fix", FIX, b"\0\1\0\0" + bytes(5), stamp_ns(k))
    with BagReader(tmp_path / "bag.mcap") as bag:
        table = bag.imu()
        fixes = list(bag.messages("/gnss/fix"))

    assert table.stamp_ns.tolist() == [stamp_ns(k) for k in range(100)]
    assert table.specific_force[:, 2].tolist() == [9.8] * 100
    assert table.frames == ((0, "imu_link"), (50, "other"))
    assert len(fixes) == 100
    assert sum("are left out" in line for line in caplog.messages) == 2


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


def test_messages_without_bytes_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "bag.mcap"
    with path.open("wb") as file:
        writer = GeneralMcapWriter(file)
        writer.start("ros2")
        schema = writer.register_schema(IMU, "ros2msg", b"")
        channel = writer.register_channel("/imu/data", "cdr", schema)
        for k in range(3):
            writer.add_message(channel, k, b"" if k == 1 else serialised(imu_message(k)), k)
        writer.finish()
    with BagReader(path) as bag:
        assert [t for _, t, _ in bag.raw()] == [0, 2]
        assert len(bag.imu().stamp_ns) == 2


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
