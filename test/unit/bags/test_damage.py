"""Recordings that break off or are damaged: read as far as they are sound."""

import os
import random
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import IndexType
from mcap.writer import Writer as GeneralMcapWriter
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_typestore
from support.bags import TYPES, imu_message, serialised, stamp_ns, write_flight
from support.paths import ROOT

from hybrid_ins.bags import mcap_reader
from hybrid_ins.bags.reader import BagReader
from hybrid_ins.errors import InputError
from hybrid_ins.ros.messages.type_names import IMU


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_flight(tmp_path_factory.mktemp("flight") / "flight.mcap", 12_000)


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


def test_a_ros1_bag_whose_recorder_was_killed_is_refused_with_its_repair(tmp_path: Path) -> None:
    bag = make_ros1(tmp_path / "killed")
    bag.write_bytes(bag.read_bytes()[:-1000])

    assert "repair it by rosbag reindex, or fetch the bag again" in complaint_about(bag)


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
    assert "crc validation failed" in caplog.text
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


def test_a_damaged_index_of_the_chunks_costs_nothing(
    tmp_path: Path, flight: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The summary says that a chunk begins elsewhere."""
    data = bytearray(flight.read_bytes())
    with flight.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    place = summary.chunk_indexes[1].chunk_start_offset.to_bytes(8, "little")
    data[data.rindex(place)] ^= 1
    (tmp_path / "bag.mcap").write_bytes(data)
    with BagReader(flight) as whole, BagReader(tmp_path / "bag.mcap") as bag:
        assert list(bag.raw()) == list(whole.raw())
    assert "its index fails its checksum" in caplog.text


MEMORY = """
import pathlib, sys
from hybrid_ins.bags.reader import BagReader
def peak():  # of this program; ru_maxrss is at least that of the process that started it
    status = pathlib.Path("/proc/self/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0])
before = peak()
with BagReader(sys.argv[1]) as bag:
    print(sum(1 for _ in bag.raw()), end=" ")
print((peak() - before) // 1024)
"""


@pytest.mark.slow
@pytest.mark.parametrize("index", [True, False], ids=["indexed", "without index"])
def test_a_small_file_of_a_huge_chunk_takes_bounded_memory(tmp_path: Path, index: bool) -> None:
    """GIVEN 6 kB that become two million messages WHEN read THEN it takes a few times them."""
    size = 2_000_000
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
    assert int(megabytes) < 300  # 350 with a list of the messages


def test_a_chunk_that_claims_too_much_is_skipped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    path = write_flight(tmp_path / "bag.mcap", 2000)
    monkeypatch.setattr(mcap_reader, "LARGEST_CHUNK", 200_000)
    with BagReader(path) as bag:
        assert 0 < len(bag.imu().stamp_ns) < 2000
    assert "more than 200000" in caplog.text
