"""The programs: each module parses its options and makes one call."""

import sys
from multiprocessing import current_process
from pathlib import Path
from types import TracebackType

from hybrid_ins import signals


def _report(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Print a line instead of a traceback for Ctrl-C while a program's imports are loaded."""
    if issubclass(kind, KeyboardInterrupt):
        print(f"{Path(sys.argv[0]).name}: interrupted", file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)


sys.excepthook = _report
if getattr(current_process(), "_inheriting", False):  # loaded by a process beside the program's
    signals.leave_to_the_parent()  # which reports them
