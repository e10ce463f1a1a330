"""Work on bags without any: what processes of their own, which import it by its name, can do."""

import os
import signal
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
