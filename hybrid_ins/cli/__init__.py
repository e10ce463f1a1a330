"""The programs: each module parses its options and makes one call."""

import signal
import sys
from multiprocessing import current_process
from pathlib import Path
from types import TracebackType


def _report(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Print a line instead of a traceback for Ctrl-C while a program's imports are loaded."""
    if issubclass(kind, KeyboardInterrupt):
        print(f"{Path(sys.argv[0]).name}: interrupted", file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)


sys.excepthook = _report
if getattr(current_process(), "_inheriting", False):  # loaded by a process beside the program's
    for number in (signal.SIGINT, signal.SIGHUP):  # those of a terminal are the program's to report
        signal.signal(number, signal.SIG_IGN)
