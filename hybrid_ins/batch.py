"""
Many bags: in parallel, resumed after an interruption, one table at the end.

A bag that cannot be used is reported and does not stop the rest. What is finished leaves a record
beside its output, with everything that the result depends on: the same command again does only what
is missing.
"""

from __future__ import annotations

import json
import os
import sys
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, as_completed, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

from tqdm import tqdm

from hybrid_ins import progress
from hybrid_ins.bags.formats import A_BAG, METADATA
from hybrid_ins.errors import InputError
from hybrid_ins.output_file import resolved, write_text
from hybrid_ins.worker_processes import ended_in_order, worker_processes

SUFFIXES = (".mcap", ".db3", ".bag")
CLUSTER_PATIENCE = "10s"
KILLED = "its process was killed each time, probably for want of memory: make room, or cut the bag"

Row = dict[str, Any]  # what the table shows of a bag, by column


@dataclass(frozen=True)
class Job:
    """A bag to work on, and where the record of its result is kept, if it is."""

    name: str
    source: Path
    record: Path | None


@dataclass(frozen=True)
class Outcome:
    """The result for a bag: its row, or why there is none."""

    name: str
    row: Row
    failure: str = ""
    kept: bool = False  # from an earlier run


def is_bag(path: Path) -> bool:
    """Return whether a path looks like one recording: a file, or a rosbag2 directory."""
    if not path.is_dir():
        return True
    return (path / METADATA).is_file() or any(
        file.suffix in SUFFIXES for file in path.glob(f"{path.resolve().name}_*")
    )


def find_jobs(paths: Sequence[Path], out: Path | None) -> list[Job]:
    """
    List the bags that are given, or lie in or below a given folder; records go to `out`.

    Raises
    ------
    InputError
        There is none, two would have the same name, or `out` is a bag or another file.
    """
    if out is not None and out.exists() and is_bag(out):
        raise InputError(f"{out}: is no folder for the results of many bags: name one, last")
    sources: dict[str, Path] = {}
    for path in paths:
        for bag, name in _bags_below(path, out and resolved(out)):
            if name in sources and sources[name].resolve() != bag.resolve():
                raise InputError(f"{sources[name]} and {bag} would both become {name}: rename one")
            sources[name] = bag
    if not sources:
        raise InputError(f"{', '.join(map(str, paths))}: no bag in there: a bag is {A_BAG}")
    return [Job(name, bag, out and out / f"{name}.json") for name, bag in sorted(sources.items())]


def _bags_below(path: Path, out: Path | None) -> Iterator[tuple[Path, str]]:
    if is_bag(path):
        name = (path if path.name not in ("", "..") else path.resolve()).name
        yield path, name.removesuffix(path.suffix if path.suffix in SUFFIXES else "")
        return
    for folder, folders, files in os.walk(path):
        here = Path(folder)
        # Not what an earlier run wrote, nor the parts of a bag.
        folders[:] = sorted(f for f in folders if (here / f).resolve() != out)
        inner = [f for f in folders if is_bag(here / f)]
        folders[:] = [f for f in folders if f not in inner]
        for name in [*inner, *sorted(files)]:
            bag = here / name
            if name in inner or (bag.suffix in SUFFIXES and not name.startswith(".")):
                yield (
                    bag,
                    str(bag.relative_to(path)).removesuffix("" if name in inner else bag.suffix),
                )


def made_from(source: Path, settings: Mapping[str, Any]) -> dict[str, Any]:
    """
    Return all that a result depends on, by its name, as JSON holds it.

    Settings and the package's version; and size [bytes] and age [ns] of every file of the bag, and
    of those that settings name.
    """
    single: dict[str, Any] = {}
    for name, value in settings.items():
        if isinstance(value, Mapping):
            single.update({f"{name} {part}": one for part, one in value.items()})
        else:
            single[name] = value
    found: dict[str, Any] = {**single, "version": _package_version()}
    for path in [source, *filter(None, map(_named, single.values()))]:
        for file in path.rglob("*") if path.is_dir() else [path]:
            about = file.stat()
            found[str(file.resolve())] = [about.st_size, about.st_mtime_ns]
    return dict(json.loads(json.dumps(found, default=str)))


def _named(value: object) -> Path | None:
    """Return the file or bag that a setting names, if it names one."""
    if isinstance(value, Path):
        return value
    with suppress(OSError):  # too long for a name
        if isinstance(value, str) and Path(value).is_file():
            return Path(value)
    return None


def changes(job: Job, settings: Mapping[str, Any]) -> str:
    """Return what differs from what a job's record was made from, as text."""
    before = {} if job.record is None else _read_record(job.record).get("made from", {})
    if not before:
        return "its record cannot be read"
    now = made_from(job.source, settings)
    texts = [
        f"{name} has changed" if name.startswith("/") else f"{name} was {old}, is {new}"
        for name in sorted(before.keys() | now.keys())
        if (old := before.get(name)) != (new := now.get(name))
    ]
    more = f" and {len(texts) - 3} more" if len(texts) > 3 else ""
    return ", ".join(texts[:3]) + more


def run(
    jobs: Sequence[Job],
    work: Callable[[Job], Row],
    settings: Mapping[str, Any],
    *,
    output: Callable[[Job], Path] | None = None,
    redo: bool = False,
    workers: int = 1,
    cluster: str | None = None,
) -> int:
    """
    Do `work` on every job that is not finished, print the table of all, and report failures.

    Parameters
    ----------
    jobs
        Bags.
    work
        Returns a row of the table; raises `InputError` on a bag that cannot be used. It runs in
        another process: a module's function, or a `functools.partial` of one.
    settings
        All that the result depends on besides the bag, a value or a mapping each; of files that
        they name the result depends, too.
    output
        Where `work` leaves what the record tells of, if it leaves anything: a module's function.
        A job whose output is gone is done again.
    redo
        Ignore the results of earlier runs.
    workers
        Processes on this machine.
    cluster
        Address of a Dask scheduler, whose workers are used instead.

    Raises
    ------
    InputError
        Some bags failed; all others are done. Or no cluster answers.
    """
    attempt = partial(_attempt, work, settings, output, redo)
    outcomes: list[Outcome] = []
    results = _by_processes(attempt, jobs, workers)
    if cluster is not None:
        results = _by_cluster(attempt, jobs, cluster)
    with closing(results):
        for outcome in progress.track(results, "bags", len(jobs), "bag"):
            outcomes.append(outcome)
            if outcome.failure:
                tqdm.write(f"{outcome.name}: {outcome.failure}", file=sys.stderr)
    outcomes.sort(key=lambda outcome: outcome.name)
    print(table(outcomes))
    failed = [outcome for outcome in outcomes if outcome.failure]
    kept = sum(outcome.kept for outcome in outcomes)
    if kept:
        print(f"{kept} of {len(outcomes)} bags were finished before")
    if failed:
        names = ", ".join(outcome.name for outcome in failed[:5])
        more = f" and {len(failed) - 5} more" if len(failed) > 5 else ""
        raise InputError(f"{len(failed)} of {len(outcomes)} bags failed: {names}{more}")
    return 0


def _package_version() -> str:
    """Return the installed package's version; empty for one that runs from its sources alone."""
    try:
        return metadata.version("hybrid_ins")
    except metadata.PackageNotFoundError:
        return ""


def table(outcomes: Iterable[Outcome]) -> str:
    """Return a line for each bag, numbers in columns."""
    outcomes = list(outcomes)
    columns = list(dict.fromkeys(column for outcome in outcomes for column in outcome.row))
    rows = {outcome.name: [_cell(outcome.row.get(c)) for c in columns] for outcome in outcomes}
    done = [columns, *(rows[outcome.name] for outcome in outcomes if not outcome.failure)]
    widths = [max(map(len, cells)) for cells in zip(*done, strict=True)]
    first = max(map(len, ["bag", *rows]))

    def line(name: str, cells: Sequence[str]) -> str:
        padded = (cell.rjust(width) for cell, width in zip(cells, widths, strict=True))
        return "  ".join([name.ljust(first), *padded]).rstrip()

    return "\n".join(
        [
            line("bag", columns),
            *(
                f"{outcome.name.ljust(first)}  failed: {outcome.failure}"
                if outcome.failure
                else line(outcome.name, rows[outcome.name])
                for outcome in outcomes
            ),
        ]
    )


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _attempt(
    work: Callable[[Job], Row],
    settings: Mapping[str, Any],
    output: Callable[[Job], Path] | None,
    redo: bool,
    job: Job,
) -> Outcome:
    """Do one job, or return its recorded result; a failure is an outcome, too."""
    progress.hide()
    try:
        mark = made_from(job.source, settings)
        record = {} if redo or job.record is None else _read_record(job.record)
        if record.get("made from") == mark and (output is None or output(job).exists()):
            return Outcome(job.name, record["row"], kept=True)
        with ended_in_order():
            row = work(job)
        if job.record is not None:
            job.record.parent.mkdir(parents=True, exist_ok=True)
            write_text(job.record, json.dumps({"made from": mark, "row": row}, indent=1))
    except InputError as error:
        return Outcome(job.name, {}, str(error).removeprefix(f"{job.source}: "))
    except OSError as error:
        return Outcome(job.name, {}, f"{error.filename or job.source}: {error.strerror or error}")
    except Exception as error:  # a defect must not cost the other bags
        place = traceback.extract_tb(error.__traceback__)[-1]
        return Outcome(
            job.name,
            {},
            f"{type(error).__name__}: {error} ({Path(place.filename).name}:{place.lineno})",
        )
    return Outcome(job.name, row)


def _read_record(path: Path) -> dict[str, Any]:
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    parts = [record.get(name) for name in ("made from", "row")] if isinstance(record, dict) else []
    return record if parts and all(isinstance(part, dict) for part in parts) else {}


def _by_processes(
    attempt: Callable[[Job], Outcome], jobs: Sequence[Job], workers: int
) -> Generator[Outcome, None, None]:
    """
    Yield outcomes of processes of this machine as they come.

    Where one is killed, the pool and with it the jobs in work are lost, and nobody knows whose it
    was: each of them is done again alone, and has failed if that is killed, too. One that was
    complete, but not told of, has its record by then: it is a result of this run all the same.
    """
    waiting = deque(jobs)
    while waiting:
        for job in (yield from _until_one_is_killed(attempt, waiting, workers)):
            again = partial(_of_this_run, attempt)
            if (yield from _until_one_is_killed(again, deque([job]), 1)):
                yield Outcome(job.name, {}, KILLED)


def _of_this_run(attempt: Callable[[Job], Outcome], job: Job) -> Outcome:
    return replace(attempt(job), kept=False)


def _until_one_is_killed(
    attempt: Callable[[Job], Outcome], waiting: deque[Job], workers: int
) -> Generator[Outcome, None, list[Job]]:
    """Take jobs until none waits, and yield their outcomes; return those that were lost."""
    running: dict[Future[Outcome], Job] = {}
    with worker_processes(min(workers, len(waiting))) as executor:
        try:
            while waiting or running:
                while waiting and len(running) < workers:
                    future = executor.submit(attempt, waiting[0])
                    running[future] = waiting.popleft()
                done = wait(running, return_when=FIRST_COMPLETED).done
                for future in sorted(done, key=lambda one: one.exception() is not None):
                    outcome = future.result()
                    del running[future]
                    yield outcome
        except BrokenProcessPool:
            return list(running.values())
    return []


def _by_cluster(
    attempt: Callable[[Job], Outcome], jobs: Sequence[Job], address: str
) -> Generator[Outcome, None, None]:
    """Yield outcomes of a Dask cluster, which itself does again what a killed process lost."""
    with _dask_client(address) as client:
        executor = client.get_executor()
        futures = {executor.submit(attempt, job): job for job in jobs}
        for future in as_completed(futures):
            try:
                yield future.result()
            except Exception as error:  # Dask's own, for a job that it gave up
                yield Outcome(futures[future].name, {}, f"{KILLED} ({type(error).__name__})")


def _dask_client(address: str) -> Any:
    try:
        from distributed import Client
    except ImportError:
        raise InputError("--dask needs dask: pip install dask distributed") from None
    try:
        return Client(address, timeout=CLUSTER_PATIENCE)
    except (OSError, ValueError) as error:
        raise InputError(f"--dask {address}: no cluster answers there ({error})") from None
