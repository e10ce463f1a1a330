"""Many bags at once: what is done, kept, done again, and reported."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.paths import ROOT

from hybrid_ins import batch
from hybrid_ins.bags.reader import BagReader
from hybrid_ins.cli import evaluate, replay, simulate
from hybrid_ins.errors import InputError
from tools.processes import Processes

HEADING = ["-p", "alignment.heading_source:=parameter", "-p", "alignment.yaw:=1.570796"]
ALONE = ["--jobs", "1"]  # a process takes seconds to start
ENVIRONMENT = {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}


@pytest.fixture(scope="module")
def flights_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two good bags, one of them a directory and deeper, and one that is no bag."""
    folder = tmp_path_factory.mktemp("fleet") / "flights"
    (folder / "monday").mkdir(parents=True)
    for name, seed in (("one.mcap", 1), ("monday/two", 2)):
        assert (
            simulate.main(
                [str(folder / name), "--duration", "8", "--imu-rate", "100", "--seed", str(seed)]
            )
            == 0
        )
    (folder / "broken.mcap").write_bytes(b"no bag at all")
    (folder / "notes.txt").write_text("not a bag")
    return folder


@pytest.fixture
def folder(flights_dir: Path, tmp_path: Path) -> Path:
    shutil.copytree(flights_dir, tmp_path / "flights")
    return tmp_path / "flights"


def ages(out: Path) -> dict[str, int]:
    return {str(p.relative_to(out)): p.stat().st_mtime_ns for p in sorted(out.rglob("*.mcap"))}


def test_bags_are_found_by_what_they_are(flights_dir: Path) -> None:
    jobs = batch.find_jobs([flights_dir], flights_dir / "out")

    assert [job.name for job in jobs] == ["broken", "monday/two", "one"]
    assert jobs[1].source == flights_dir / "monday" / "two"
    assert jobs[1].record == flights_dir / "out" / "monday" / "two.json"
    assert batch.is_bag(flights_dir / "monday" / "two")
    assert not batch.is_bag(flights_dir)


def test_an_output_folder_inside_the_input_is_not_input(flights_dir: Path) -> None:
    (flights_dir / "out").mkdir(exist_ok=True)
    shutil.copy(flights_dir / "one.mcap", flights_dir / "out" / "one.mcap")

    names = [job.name for job in batch.find_jobs([flights_dir], flights_dir / "out")]

    shutil.rmtree(flights_dir / "out")
    assert names == ["broken", "monday/two", "one"]


def test_bags_of_one_name_are_refused(flights_dir: Path, tmp_path: Path) -> None:
    other = tmp_path / "one.mcap"
    shutil.copy(flights_dir / "one.mcap", other)

    with pytest.raises(InputError, match="rename one"):
        batch.find_jobs([flights_dir, other], tmp_path / "out")


@pytest.mark.slow
def test_a_fleet_is_replayed_resumed_and_evaluated(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """GIVEN a folder with a bad bag WHEN replayed THEN the rest is done, and done only once."""
    out = tmp_path / "estimates"

    assert replay.main([str(folder), str(out), *HEADING, "--jobs", "2"]) == 2
    said = capsys.readouterr()
    assert "1 of 3 bags failed: broken" in said.err
    rows = {line.split()[0]: line for line in said.out.splitlines()}
    assert "failed:" in rows["broken"]
    assert rows["broken"].count("broken") == 1  # a name is not said twice
    assert "is not a bag" in rows["broken"]
    assert "fixes fused" in rows["bag"]
    assert sorted(ages(out)) == ["monday/two.mcap", "one.mcap"]
    with BagReader(out / "monday" / "two.mcap") as bag:
        assert bag.count("/odometry") > 500
        assert bag.count("/truth/odometry") > 500

    # Again: nothing is done twice; another parameter: only if that is asked for.
    first = ages(out)
    (folder / "broken.mcap").unlink()
    assert replay.main([str(folder), str(out), *HEADING, *ALONE]) == 0
    assert "2 of 2 bags were finished before" in capsys.readouterr().out
    assert ages(out) == first
    (out / "one.json").unlink()  # as if it had been interrupted before it was complete
    assert replay.main([str(folder), str(out), *HEADING, *ALONE, "--overwrite"]) == 0
    done = ages(out)
    assert done["one.mcap"] != first["one.mcap"]
    capsys.readouterr()
    other = [str(folder), str(out), *HEADING, *ALONE, "-p", "noise.mode:=constant"]
    assert replay.main(other) == 2
    assert "(parameter noise.mode was learned, is constant)" in capsys.readouterr().err
    assert ages(out) == done
    assert replay.main([*other, "--overwrite"]) == 0
    assert "finished before" not in capsys.readouterr().out
    assert all(ages(out)[name] != age for name, age in done.items())

    results = tmp_path / "results"
    assert evaluate.main([str(out), "--results", str(results), *ALONE]) == 0
    said = capsys.readouterr()
    assert "PRMSE [m]" in said.out
    assert [line.split()[0] for line in said.out.splitlines()] == ["bag", "monday/two", "one"]
    row = json.loads((results / "one.json").read_text())["row"]
    assert 0.0 < row["PRMSE [m]"] < 1.0
    assert evaluate.main([str(out), "--results", str(results)]) == 0
    assert "2 of 2 bags were finished before" in capsys.readouterr().out


@pytest.mark.slow
def test_a_strangers_file_is_not_replaced(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "estimates"
    out.mkdir()
    (out / "one.mcap").write_bytes(b"precious")

    assert (
        replay.main([str(folder / "one.mcap"), str(folder / "monday" / "two"), str(out), *HEADING])
        == 2
    )

    assert "--overwrite to replace it" in capsys.readouterr().out
    assert (out / "one.mcap").read_bytes() == b"precious"
    assert (out / "two.mcap").exists()


def test_several_named_bags_and_options_for_one(
    flights_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert evaluate.main([str(flights_dir), "--json"]) == 2
    assert "one bag at a time" in capsys.readouterr().err
    empty = flights_dir.parent / "empty"
    empty.mkdir(exist_ok=True)
    assert replay.main([str(empty), str(flights_dir.parent / "out")]) == 2
    assert (
        "no bag in there: a bag is a folder with metadata.yaml, or an .mcap"
        in capsys.readouterr().err
    )


@pytest.mark.slow
def test_an_interrupted_fleet_goes_on_where_it_was(tmp_path: Path) -> None:
    """GIVEN a run ended by Ctrl-C after its first bag WHEN started again THEN that one is kept."""
    folder, out = tmp_path / "flights", tmp_path / "out"
    folder.mkdir()
    for seed in range(4):
        assert (
            simulate.main(
                [
                    str(folder / f"{seed}.mcap"),
                    "--duration",
                    "20",
                    "--imu-rate",
                    "100",
                    "--seed",
                    str(seed),
                ]
            )
            == 0
        )
    command = [
        sys.executable,
        "-c",
        "import sys; from hybrid_ins.cli.replay import main; sys.exit(main())",
        str(folder),
        str(out),
        *HEADING,
        "--jobs",
        "1",
    ]
    with Processes() as processes:
        running = processes.start(command, subprocess.PIPE, ENVIRONMENT)
        end = time.monotonic() + 120.0
        while not (out / "0.json").exists() and running.poll() is None:
            assert time.monotonic() < end
            time.sleep(0.01)
        running.send_signal(signal.SIGINT)
        text, _ = running.communicate(timeout=60)
    assert running.returncode == 130, text
    finished = {path.stem: path.stat().st_mtime_ns for path in out.glob("*.json")}
    assert 0 < len(finished) < 4
    assert {path.stem for path in out.glob("[0-9].mcap")} == set(finished)

    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
        env=os.environ | ENVIRONMENT,
    )

    assert done.returncode == 0, done.stderr
    assert f"{len(finished)} of 4 bags were finished before" in done.stdout
    assert all((out / f"{name}.json").stat().st_mtime_ns == age for name, age in finished.items())
    assert len(list(out.glob("[0-9].mcap"))) == 4
    assert not list(out.glob(".*"))


@pytest.fixture
def cluster() -> Iterator[str]:
    distributed = pytest.importorskip("distributed", reason="dask is not installed")
    environment = os.environ | ENVIRONMENT
    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=True,
        dashboard_address=None,
        env={"PYTHONPATH": environment["PYTHONPATH"]},
    ) as running:
        yield running.scheduler_address


@pytest.mark.slow
def test_a_dask_cluster_of_two_workers(
    folder: Path, tmp_path: Path, cluster: str, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "estimates"

    assert replay.main([str(folder), str(out), *HEADING, "--dask", cluster]) == 2

    assert "1 of 3 bags failed: broken" in capsys.readouterr().err
    assert sorted(ages(out)) == ["monday/two.mcap", "one.mcap"]


def test_a_cluster_that_is_not_there(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed", reason="dask is not installed")
    monkeypatch.setattr(batch, "CLUSTER_PATIENCE", "1s")

    assert evaluate.main([str(folder), "--dask", "tcp://127.0.0.1:9"]) == 2

    assert "no cluster answers" in capsys.readouterr().err
