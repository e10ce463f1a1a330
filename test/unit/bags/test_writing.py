"""Bags are complete or absent, whatever ends their writer."""

import errno
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from mcap.reader import make_reader
from support.bags import FIX, imu_message, stamp_ns, write_flight
from support.paths import ROOT

from hybrid_ins.bags.messages import new_message
from hybrid_ins.bags.reader import BagReader
from hybrid_ins.bags.writer import BagWriter
from hybrid_ins.errors import InputError
from hybrid_ins.ros.messages.type_names import IMU


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


@pytest.mark.slow
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
    with BagReader(tmp_path / "bag.part") as bag:
        count = len(bag.imu().stamp_ns)
    assert 6000 < count < 10_000
    assert "not completed: no metadata.yaml" in caplog.text
    assert "breaks off" in caplog.text
    writer.close()


def test_nothing_is_overwritten_unasked(tmp_path: Path) -> None:
    path = write_flight(tmp_path / "bag", 100)
    with pytest.raises(InputError, match="exists: give --overwrite, or choose another name"):
        BagWriter(path)
    with BagWriter(path, overwrite=True) as bag:
        bag.write("/imu/data", imu_message(0), stamp_ns(0))
    with BagReader(path) as bag:
        assert bag.count("/imu/data") == 1
    (path / "thesis.tex").write_text("years of work")
    with pytest.raises(InputError, match="holds other files than those of one bag"):
        BagWriter(path, overwrite=True)


@pytest.fixture
def full_disk() -> Iterator[None]:
    """No file may grow beyond a megabyte."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, limits[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.mark.usefixtures("full_disk")
def test_a_full_disk_is_one_clear_line(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """What there was room for stays, beside the bag's place."""

    def record() -> None:
        with BagWriter(tmp_path / "bag.mcap") as bag:
            for k in range(10_000):
                bag.write("/imu/data", imu_message(k), stamp_ns(k))

    with pytest.raises(InputError, match=r"cannot be written .File too large.: make room"):
        record()
    assert "bag.mcap.part: is incomplete" in caplog.text
    assert not (tmp_path / "bag.mcap").exists()
    assert count(tmp_path / "bag.mcap.part") > 1000


def test_no_room_for_temporary_files_names_the_bag_and_the_remedy(tmp_path: Path) -> None:
    with (
        pytest.raises(InputError, match=r"bag.mcap: cannot be written .full.: make room"),
        BagWriter(tmp_path / "bag.mcap", keep_partial=False),
    ):
        raise OSError(errno.ENOSPC, "full")
    assert not list(tmp_path.iterdir())


def test_topics_of_one_type_and_of_several(tmp_path: Path) -> None:
    topics = {"/a": IMU, "/b": IMU, "/c": FIX, "/d": IMU, "/e": FIX}
    with BagWriter(tmp_path / "bag.mcap") as bag:
        for topic, type_name in topics.items():
            bag.write(topic, new_message(type_name), stamp_ns(0))
    with BagReader(tmp_path / "bag.mcap") as bag_read:
        assert bag_read.topics == topics
    with (tmp_path / "bag.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert sorted(schema.name for schema in summary.schemas.values()) == sorted({IMU, FIX})


def test_misuse_of_the_writer(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag.mcap") as bag:
        bag.write("/imu/data", imu_message(0), stamp_ns(0))
        with pytest.raises(ValueError, match=r"/imu/data holds .*Imu, not .*NavSatFix"):
            bag.write("imu/data", new_message(FIX), stamp_ns(0))
        with pytest.raises(ValueError, match="not a standard message type"):
            bag.write_raw("/own", "own_msgs/msg/Own", b"", stamp_ns(0))
        with pytest.raises(ValueError, match="before the epoch"):
            bag.write("/imu/data", imu_message(0), -1)
    with BagReader(tmp_path / "bag.mcap") as reader:
        assert reader.count("/imu/data") == 1


# --- a bag in the place of another ----------------------------------------------------------------


def count(path: Path) -> int:
    with BagReader(path) as bag:
        return bag.count("/imu/data")


@pytest.mark.parametrize("name", ["bag", "bag.mcap"])
def test_the_old_bag_stays_until_the_new_one_is_complete(tmp_path: Path, name: str) -> None:
    path = write_flight(tmp_path / name, 100)
    with BagWriter(path, overwrite=True) as bag:
        bag.write("/imu/data", imu_message(0), stamp_ns(0))
        assert count(path) == 100
    assert count(path) == 1
    assert [p.name for p in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("name", ["bag", "bag.mcap"])
@pytest.mark.parametrize("keep_partial", [True, False])
def test_the_old_bag_survives_a_failure(tmp_path: Path, name: str, keep_partial: bool) -> None:
    """The new one is beside it, if it is wanted at all."""
    path = write_flight(tmp_path / name, 100)
    for _ in range(2):
        with (
            pytest.raises(KeyboardInterrupt),
            BagWriter(path, overwrite=True, keep_partial=keep_partial) as bag,
        ):
            bag.write("/imu/data", imu_message(0), stamp_ns(0))
            raise KeyboardInterrupt
    assert count(path) == 100
    others = sorted(p.name for p in tmp_path.iterdir() if p != path)
    suffix = path.suffix
    assert others == [f"bag.partial{suffix}", f"bag.partial2{suffix}"] * keep_partial
    assert [count(tmp_path / other) for other in others] == [1, 1] * keep_partial


@pytest.mark.parametrize(
    "out", ["bag", "bag/bag_0.mcap", "link", "sub/../bag", "other/bag", "other"]
)
def test_no_bag_replaces_one_that_is_read(
    tmp_path: Path, out: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """GIVEN a bag, links to it and to its folder WHEN it is the output, too THEN it is whole."""
    monkeypatch.chdir(tmp_path)
    write_flight(tmp_path / "bag", 100)
    (tmp_path / "link").symlink_to("bag")
    (tmp_path / "other").symlink_to(tmp_path)
    (tmp_path / "sub").mkdir()
    with pytest.raises(InputError, match=r"the input (bag|itself): (give|choose)"):
        BagWriter(out, overwrite=True, inputs=[Path("bag")])
    assert count(tmp_path / "bag") == 100


def test_a_link_keeps_pointing_to_the_bag(tmp_path: Path) -> None:
    write_flight(tmp_path / "bag", 100)
    (tmp_path / "link").symlink_to("bag")
    with BagWriter(tmp_path / "link", overwrite=True) as bag:
        bag.write("/imu/data", imu_message(0), stamp_ns(0))
    assert (tmp_path / "link").is_symlink()
    assert count(tmp_path / "bag") == 1


@pytest.mark.parametrize("content", ["years of work", "\x89MCAP"])
def test_a_file_that_is_no_bag_is_not_replaced(tmp_path: Path, content: str) -> None:
    path = tmp_path / "thesis.mcap"
    path.write_text(content)
    with pytest.raises(InputError, match="is not a bag: not overwritten"):
        BagWriter(path, overwrite=True)
    assert path.read_text() == content


@pytest.mark.parametrize("other", ["notes.yaml", "other.mcap", "two"])
def test_a_folder_of_bags_is_no_bag(tmp_path: Path, other: str) -> None:
    """Recordings of others, and parameter files, lie in folders, too."""
    folder = tmp_path / "flights"
    write_flight(folder / "flights_0.mcap", 10)
    (folder / other).mkdir() if other == "two" else (folder / other).write_bytes(b"\x89MCAP0\r\n")
    with pytest.raises(InputError, match="other files than those of one bag"):
        BagWriter(folder, overwrite=True)
    assert len(list(folder.iterdir())) == 2


def test_a_bag_that_was_renamed_is_a_bag(tmp_path: Path) -> None:
    path = write_flight(tmp_path / "bag", 10).rename(tmp_path / "renamed")
    with BagWriter(path, overwrite=True) as bag:
        bag.write("/imu/data", imu_message(0), stamp_ns(0))
    assert count(path) == 1


def test_what_appears_meanwhile_is_not_replaced(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "bag")
    bag.write("/imu/data", imu_message(0), stamp_ns(0))
    write_flight(tmp_path / "other", 100).rename(tmp_path / "bag")
    with pytest.raises(InputError, match=r"exists meanwhile: the new bag is .*bag\.part"):
        bag.close()
    assert (count(tmp_path / "bag"), count(tmp_path / "bag.part")) == (100, 1)


def test_what_a_killed_writer_left_is_set_aside(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    killed = BagWriter(tmp_path / "bag")
    for k in range(2000):
        killed.write("/imu/data", imu_message(k), stamp_ns(k))
    with pytest.raises(InputError, match="another process is writing it"):
        BagWriter(tmp_path / "bag")
    killed._writer.abandon()  # as the system does

    with BagWriter(tmp_path / "bag") as bag:
        bag.write("/imu/data", imu_message(0), stamp_ns(0))

    assert "bag.partial: what an earlier run wrote before it was killed" in caplog.text
    assert (count(tmp_path / "bag"), count(tmp_path / "bag.partial") > 500) == (1, True)


def test_a_discarded_bag_leaves_nothing(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        bag.write("/imu/data", imu_message(0), stamp_ns(0))
        bag.discard()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("keep_partial", [True, False])
@pytest.mark.parametrize("name", ["bag", "bag.mcap"])
@pytest.mark.parametrize("other", ["{}.old", "{}.part", ".{}.part"])
def test_what_this_program_did_not_make_stays(
    tmp_path: Path, name: str, other: str, keep_partial: bool
) -> None:
    """GIVEN a user's file and folder beside a bag WHEN that is replaced THEN they are untouched."""
    path = write_flight(tmp_path / name, 100)
    notes = tmp_path / other.format(name)
    for content in (notes / "notes.txt", notes):  # a folder, then a file
        content.parent.mkdir(exist_ok=True)
        content.write_text("precious")
        with (
            suppress(InputError),  # it may be where the part is to be written
            BagWriter(path, overwrite=True, keep_partial=keep_partial) as bag,
        ):
            bag.write("/imu/data", imu_message(0), stamp_ns(0))
        assert content.read_text() == "precious"
        if content != notes:
            shutil.rmtree(notes)


def test_what_is_no_part_is_named(tmp_path: Path) -> None:
    (tmp_path / "bag.mcap.part").write_text("precious")
    with pytest.raises(InputError, match=r"bag\.mcap\.part: is not an unfinished bag .*rename it"):
        BagWriter(tmp_path / "bag.mcap")


def test_a_hidden_part_that_a_killed_writer_left_is_removed(tmp_path: Path) -> None:
    killed = BagWriter(tmp_path / "bag.mcap", keep_partial=False)
    killed.write("/imu/data", imu_message(0), stamp_ns(0))
    killed.flush()
    killed._writer.abandon()  # as the system does
    assert [p.name for p in tmp_path.iterdir()] == [".bag.mcap.part"]

    with BagWriter(tmp_path / "bag.mcap", keep_partial=False) as bag:
        bag.write("/imu/data", imu_message(0), stamp_ns(0))

    assert [p.name for p in tmp_path.iterdir()] == ["bag.mcap"]
