"""The shell around every program: option parser, messages on stderr, exit status."""

import argparse
import errno
import io
import logging
import os
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, NoReturn

from tqdm import tqdm

from hybrid_ins import kernel_cache, signals
from hybrid_ins.errors import InputError

EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130
EXIT_BY_SIGNAL = 128  # and its number


def parser(name: str, description: str, example: str = "") -> argparse.ArgumentParser:
    """Build the option parser of program `name`.

    `description` and `example` keep their line breaks in ``--help``. From here on, characters that
    the terminal's encoding lacks are printed as question marks.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    result = _Parser(
        prog=name,
        description=description,
        epilog=f"example:\n  {example}" if example else None,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    result.set_defaults(program_name=name)
    return result


class _Parser(argparse.ArgumentParser):
    """
    Reports wrong options as programs report other invalid input: in one line.

    ``-1e-3`` is a number, not an option, as it is for argparse itself from Python 3.14 on.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._negative_number_matcher = re.compile(r"-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$")

    def error(self, message: str) -> NoReturn:
        self.exit(EXIT_BAD_INPUT, f"{self.prog}: error: {message}: see {self.prog} --help\n")


def run(body: Callable[[argparse.Namespace], int | None], args: argparse.Namespace) -> int:
    """Run a program's body and turn its end into an exit status.

    Parameters
    ----------
    body
        Does the work; its return value is the exit status (None means 0).
    args
        Parsed options, handed to `body`. ``program_name`` (set by `parser`) heads every line
        on stderr.

    Returns
    -------
    int
        The body's status; 2 after bad input or a file-system error, 130 after Ctrl-C, 143 after
        SIGTERM, 129 after SIGHUP. Anything else that the body raises is a defect and keeps its
        traceback.

    """
    name = getattr(args, "program_name", Path(sys.argv[0]).name)
    kernel_cache.enable()
    stdout, stderr = _Output(sys.stdout), _Output(sys.stderr)
    with (
        redirect_stdout(stdout),
        redirect_stderr(stderr),
        _logging_to_stderr(name),
        signals.raised(),
    ):
        try:
            status = body(args) or 0
            stdout.flush()
            return status
        except InputError as error:
            print(f"{name}: error: {error}", file=sys.stderr)
            return EXIT_BAD_INPUT
        except OSError as error:
            place = f"{error.filename}: " if error.filename else ""
            print(f"{name}: error: {place}{error.strerror or error}", file=sys.stderr)
            return EXIT_BAD_INPUT
        except KeyboardInterrupt:
            print(f"{name}: interrupted", file=sys.stderr)
            return EXIT_INTERRUPTED
        except signals.Terminated as ended:
            print(f"{name}: terminated", file=sys.stderr)
            return EXIT_BY_SIGNAL + ended.number


def is_read() -> bool:
    """Return whether somebody may still read what the running program prints."""
    return bool(getattr(sys.stdout, "is_read", True))


class _Output:
    """
    A standard stream that ignores that its reader is gone (``ins_evaluate … | head``).

    Or its terminal; or that it was closed from the start (``>&-``), when Python has None in its
    place. A program that cannot print still writes its result.
    """

    def __init__(self, stream: Any) -> None:
        if stream is None:  # Its descriptor is taken, so that no file written later has it.
            stream = os.fdopen(os.open(os.devnull, os.O_WRONLY), "w", encoding="utf-8")
        self._stream = stream
        self.is_read = True

    def write(self, text: str) -> int:
        return self._unless_closed(self._stream.write, text)

    def flush(self) -> None:
        self._unless_closed(self._stream.flush)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def _unless_closed(self, action: Callable[..., Any], *arguments: Any) -> int:
        try:
            return action(*arguments) or 0
        except OSError as error:
            if error.errno not in (errno.EPIPE, errno.EIO):
                raise
            self.is_read = False
            nothing = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nothing, self._stream.fileno())  # also what is still buffered
            os.close(nothing)
            return 0


class _StderrHandler(logging.Handler):
    """Prints a line for each record, above a progress bar where there is one."""

    def __init__(self, program_name: str) -> None:
        super().__init__()
        self._program_name = program_name

    def emit(self, record: logging.LogRecord) -> None:
        level = record.levelname.lower()
        tqdm.write(f"{self._program_name}: {level}: {record.getMessage()}", file=sys.stderr)


@contextmanager
def _logging_to_stderr(program_name: str) -> Iterator[None]:
    """Within the block, print warnings, and this package's notes, in this program's name alone."""
    root, package = logging.getLogger(), logging.getLogger("hybrid_ins")
    outer = [handler for handler in root.handlers if isinstance(handler, _StderrHandler)]
    handler, level = _StderrHandler(program_name), package.level
    package.setLevel(logging.INFO)
    for one in outer:
        root.removeHandler(one)
    root.addHandler(handler)
    try:
        yield
    finally:
        root.removeHandler(handler)
        for one in outer:
            root.addHandler(one)
        package.setLevel(level)
