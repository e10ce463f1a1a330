"""Many bags: names, records, and processes that are killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest
from support.batch_work import killed_at_b, killed_at_b_before_a_is_told_of, written
from support.paths import ROOT

from hybrid_ins import batch
from hybrid_ins.cli import replay
from hybrid_ins.errors import InputError
from hybrid_ins.worker_processes import worker_processes


@pytest.fixture
def jobs(tmp_path: Path) -> list[batch.Job]:
    (tmp_path / "in").mkdir()
    for name in "abcd":
        (tmp_path / "in" / f"{name}.mcap").write_bytes(b"bag")
    return batch.find_jobs([tmp_path / "in"], tmp_path / "out")


def test_a_killed_process_costs_its_own_bag_only(
    jobs: list[batch.Job], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """GIVEN a bag whose process is killed WHEN others are in work THEN all others are done."""
    with pytest.raises(InputError, match=r"^1 of 4 bags failed: b$"):
        batch.run(jobs, killed_at_b, {}, workers=2)

    said = capsys.readouterr()
    assert "b: its process was killed each time, probably for want of memory: make room" in said.err
    rows = [line.split() for line in said.out.splitlines()]
    assert [row[0] for row in rows] == ["bag", "a", "b", "c", "d"]
    assert [row[1] for row in rows] == ["x", "1", "failed:", "1", "1"]
    assert sorted(path.stem for path in (tmp_path / "out").iterdir()) == ["a", "c", "d"]


def test_what_a_killed_process_interrupts_was_not_finished_before(
    jobs: list[batch.Job], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """GIVEN a bag with its record WHEN another's process ends the pool THEN it is of this run."""
    work = partial(killed_at_b_before_a_is_told_of, tmp_path / "out")

    with pytest.raises(InputError, match=r"^1 of 4 bags failed: b$"):
        batch.run(jobs, work, {}, workers=2)

    assert "finished before" not in capsys.readouterr().out


def test_a_killed_process_of_any_program_is_one_line() -> None:
    with (
        pytest.raises(InputError, match="a process of this program was killed"),
        worker_processes(1) as executor,
    ):
        executor.submit(os._exit, 1).result()


BATCH = """
import sys
from functools import partial
from pathlib import Path
from support.batch_work import unfinished_for_long
from hybrid_ins import batch
from hybrid_ins.cli import program

folder = Path(sys.argv[1])

def body(args):
    job = batch.Job("a", folder / "a.mcap", None)
    work = partial(unfinished_for_long, folder / "started", folder / "removed")
    return batch.run([job], work, {})

if __name__ == "__main__":
    sys.exit(program.run(body, program.parser("ins_test", "").parse_args([])))
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL])
def test_work_that_is_not_finished_is_removed_with_the_program(
    number: signal.Signals, tmp_path: Path
) -> None:
    """GIVEN a bag in work WHEN the program ends THEN its process removes what it has begun."""
    script = tmp_path / "script.py"
    script.write_text(BATCH)
    (tmp_path / "a.mcap").write_bytes(b"bag")
    search = f"{ROOT}{os.pathsep}{ROOT / 'test'}"
    process = subprocess.Popen(
        [sys.executable, script, tmp_path],
        env=os.environ | {"PYTHONPATH": search},
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=_hear_signals,
    )
    try:
        assert _appears(tmp_path / "started")
        process.send_signal(number)
        assert _appears(tmp_path / "removed")
        said = process.communicate(timeout=30)[1]  # at the end of all that have its stderr
    finally:
        process.kill()

    if number != signal.SIGKILL:
        assert said in ("ins_test: interrupted\n", "ins_test: terminated\n")


def _hear_signals() -> None:
    """Undo what ``&`` and ``nohup`` leave ignored."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


def _appears(path: Path) -> bool:
    until = time.monotonic() + 40.0
    while not path.exists() and time.monotonic() < until:
        time.sleep(0.05)
    return path.exists()


def test_a_result_depends_on_the_files_that_settings_name(
    jobs: list[batch.Job], tmp_path: Path
) -> None:
    """GIVEN a model and a folder with the truth WHEN one of them changes THEN it is named."""
    model, truth = tmp_path / "own.onnx", tmp_path / "truth"
    model.write_bytes(b"one")
    truth.mkdir()
    (truth / "truth_0.mcap").write_bytes(b"one")
    settings = {"parameter": {"noise.model": str(model), "map_frame": "map"}, "truth": truth}
    first = batch.made_from(jobs[0].source, settings)
    assert batch.made_from(jobs[0].source, settings) == first

    model.write_bytes(b"three")
    second = batch.made_from(jobs[0].source, settings)
    (truth / "truth_0.mcap").write_bytes(b"three")
    third = batch.made_from(jobs[0].source, settings)

    assert [name for name in first if first[name] != second[name]] == [str(model)]
    assert [name for name in first if third[name] != second[name]] == [str(truth / "truth_0.mcap")]


def test_an_output_that_was_made_otherwise_is_not_replaced(
    jobs: list[batch.Job], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """GIVEN an output WHEN a parameter changes THEN it stays, and the parameter is named."""
    target = tmp_path / "out" / "a.mcap"
    (tmp_path / "out").mkdir()

    def run(mode: str) -> int:
        settings = {"parameter": {"noise.mode": mode}}
        work = partial(replay._replay_new, partial(written, target), settings)
        return batch.run(jobs[:1], work, settings)

    assert run("learned") == 0
    assert run("learned") == 0
    target.write_bytes(b"precious")
    with pytest.raises(InputError):
        run("constant")

    said = "a.mcap was made otherwise (parameter noise.mode was learned, is constant): --overwrite"
    assert said in capsys.readouterr().err
    assert target.read_bytes() == b"precious"


def test_a_bag_has_its_name_from_within(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bags = [tmp_path / name for name in ("one", "two")]
    for bag in bags:
        (bag / "deep").mkdir(parents=True)
        (bag / "metadata.yaml").touch()
    monkeypatch.chdir(bags[0])

    jobs = batch.find_jobs([Path(), Path("../two")], Path("../out"))

    assert [job.name for job in jobs] == ["one", "two"]
    monkeypatch.chdir(bags[0] / "deep")
    assert [job.name for job in batch.find_jobs([Path("..")], None)] == ["one"]


def test_a_result_whose_output_was_deleted_is_made_again(
    jobs: list[batch.Job], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """GIVEN a record whose output is gone WHEN the command is repeated THEN there is one again."""
    target = tmp_path / "out" / "a.mcap"
    (tmp_path / "out").mkdir()
    work = partial(replay._replay_new, partial(written, target), {})

    def run() -> str:
        assert batch.run(jobs[:1], work, {}, output=replay._target) == 0
        return capsys.readouterr().out

    assert "finished before" not in run()
    assert "1 of 1 bags were finished before" in run()
    target.unlink()
    assert "finished before" not in run()
    assert target.read_bytes() == b"estimate"


def test_results_do_not_go_into_a_bag_or_a_file(jobs: list[batch.Job], tmp_path: Path) -> None:
    """GIVEN a forgotten output, so that the last of many bags is it THEN that bag is named."""
    for last in (jobs[3].source, tmp_path / "folder"):
        if last.name == "folder":
            last.mkdir()
            (last / "metadata.yaml").touch()
        with pytest.raises(InputError, match=f"^{last}: is no folder for the results of many"):
            batch.find_jobs([job.source for job in jobs[:3]], last)
