"""Work on bags without any: what processes of their own, which import it by its name, can do."""

import os
import signal
import time
from pathlib import Path

from hybrid_ins.batch import Job, Row


def killed_at_b(job: Job) -> Row:
    """Return a row; the process that has bag b is killed, as for want of memory."""
    if job.name == "b":
        os.kill(os.getpid(), signal.SIGKILL)
    return {"x": 1.0}


def killed_at_b_before_a_is_told_of(out: Path, job: Job) -> Row:
    """Kill the process of bag b when a has its record, but has not told its result yet."""
    if job.name == "a":
        return _ToldLate(x=1.0)
    if job.name == "b":
        while not (out / "a.json").exists():
            time.sleep(0.01)
    return killed_at_b(job)


class _ToldLate(dict[str, float]):
    """A row that takes long on its way to another process."""

    def __reduce__(self) -> tuple[type[dict[str, float]], tuple[()]]:
        time.sleep(60.0)
        return dict, ()


def written(target: Path, job: Job) -> Row:
    """Return a row after an output was made."""
    target.write_bytes(b"estimate")
    return {"x": 1.0}


def unfinished_for_long(started: Path, removed: Path, job: Job) -> Row:
    """Work until the process is ended; say when that began, and when it was in order."""
    try:
        started.touch()  # it may be ended at once
        time.sleep(60.0)
    finally:
        removed.touch()
    return {}
