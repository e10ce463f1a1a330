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


def written(target: Path, job: Job) -> Row:
    """Return a row after an output was made."""
    target.write_bytes(b"estimate")
    return {"x": 1.0}


def unfinished_for_long(started: Path, removed: Path, job: Job) -> Row:
    """Work until the process is ended; say when that began, and when it was in order."""
    started.touch()
    try:
        time.sleep(60.0)
    finally:
        removed.touch()
    return {}
