"""Outputs are complete or absent, and inputs are never replaced."""

import errno
import os
import threading
from pathlib import Path

import pytest

from hybrid_ins.bags.writer import BagWriter
from hybrid_ins.errors import InputError
from hybrid_ins.output_file import cannot_be_written, check_output, replacing, write_text


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    (tmp_path / "flight").mkdir()
    (tmp_path / "flight" / "flight_0.mcap").write_bytes(b"recording")
    return tmp_path / "flight"


@pytest.mark.parametrize(
    "out", ["flight", "flight/flight_0.mcap", "flight/new.yaml", "link", "sub/../flight", "."]
)
def test_an_input_is_no_output_whatever_it_is_called(
    bag: Path, monkeypatch: pytest.MonkeyPatch, out: str
) -> None:
    (bag.parent / "link").symlink_to(bag)
    (bag.parent / "sub").mkdir()
    monkeypatch.chdir(bag.parent)

    with pytest.raises(InputError, match=r"(is|lies in|contains) the input (flight|itself)"):
        check_output(Path(out), [Path("flight")], overwrite=True, folder=True)


def test_a_name_that_only_begins_alike_is_another_file(bag: Path) -> None:
    check_output(bag.with_name("flight.yaml"), [bag])


def test_a_link_that_leads_to_itself_is_named(tmp_path: Path) -> None:
    (tmp_path / "one").symlink_to(tmp_path / "two")
    (tmp_path / "two").symlink_to(tmp_path / "one")

    for inputs, out in (([], "one"), ([tmp_path / "one"], "out")):
        with pytest.raises(InputError, match="one: is a link that leads to itself"):
            check_output(tmp_path / out, inputs, folder=True)


@pytest.mark.parametrize("name", ["n" * 300, "closed/new"])
def test_a_place_that_cannot_be_looked_at_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    def stat(path: object, *given: object, **options: object) -> os.stat_result:
        if str(path).startswith(str(tmp_path / "closed/")):  # root may look everywhere
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return looked(path, *given, **options)  # type: ignore[arg-type]

    looked = os.stat
    (tmp_path / "closed").mkdir()
    monkeypatch.setattr(os, "stat", stat)
    with pytest.raises(InputError, match=r"cannot be written \((File name too|Permission)"):
        check_output(tmp_path / name, overwrite=True)
    if name.startswith("n"):
        with pytest.raises(InputError, match="cannot be written"):
            write_text(tmp_path / name, "text")


def test_what_exists_is_replaced_only_on_request(tmp_path: Path) -> None:
    (tmp_path / "old").write_text("old")

    with pytest.raises(InputError, match="--overwrite"):
        check_output(tmp_path / "old")
    check_output(tmp_path / "old", overwrite=True)
    with pytest.raises(InputError, match="is a folder"):
        check_output(tmp_path, overwrite=True)
    with pytest.raises(InputError, match="no such folder"):
        check_output(tmp_path / "none" / "new")


def test_a_failure_leaves_what_was_there_and_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("old")

    def fail() -> None:
        with replacing(tmp_path / "file") as unfinished:
            unfinished.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()

    assert [p.name for p in tmp_path.iterdir()] == ["file"]
    assert (tmp_path / "file").read_text() == "old"


def test_success_replaces_a_file_a_folder_and_what_a_link_points_to(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "old").touch()
    (tmp_path / "target").write_text("old")
    (tmp_path / "link").symlink_to(tmp_path / "target")

    write_text(tmp_path / "link", "nëw")
    with replacing(tmp_path / "folder") as unfinished:
        unfinished.mkdir()
        (unfinished / "new").touch()

    assert (tmp_path / "target").read_text(encoding="utf-8") == "nëw"
    assert (tmp_path / "link").is_symlink()
    assert [p.name for p in (tmp_path / "folder").iterdir()] == ["new"]


def test_an_error_names_what_the_user_typed_and_the_remedy(tmp_path: Path) -> None:
    """/proc holds no files of ours, whoever we are."""
    with pytest.raises(InputError, match=r"^/proc/x.png: cannot be written .*choose a folder"):
        check_output(Path("/proc/x.png"))
    with pytest.raises(InputError, match=r"^/proc/a/x: cannot be written .*choose a folder"):
        check_output(Path("/proc/a/x"), folder=True)
    with pytest.raises(InputError, match=r"^/proc/x.png: cannot be written .*choose a folder"):
        write_text(Path("/proc/x.png"), "text")
    with pytest.raises(InputError, match=r"^/proc/x.mcap: cannot be written .*choose a folder"):
        BagWriter(Path("/proc/x.mcap"))
    assert "make room" in str(cannot_be_written(tmp_path, OSError(errno.ENOSPC, "full")))
    with pytest.raises(FileNotFoundError), replacing(tmp_path / "new"):
        (tmp_path / "elsewhere").read_text()


def test_a_pipe_is_written_not_replaced(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    read: list[str] = []
    reader = threading.Thread(target=lambda: read.append((tmp_path / "pipe").read_text()))
    reader.start()

    write_text(tmp_path / "pipe", "text")
    reader.join(10.0)

    assert read == ["text"]
    assert (tmp_path / "pipe").is_fifo()


def test_a_file_never_takes_the_place_of_a_folder(bag: Path) -> None:
    with pytest.raises(InputError, match="Is a directory"):
        write_text(bag, "text")

    assert (bag / "flight_0.mcap").exists()
    assert list(bag.parent.iterdir()) == [bag]
