"""The shell around every program: option parser, error line, exit status."""

import argparse
import logging
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

from hybrid_ins.errors import InputError

EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130
EXIT_TERMINATED = 143


class Terminated(BaseException):
    """SIGTERM: unwinds like Ctrl-C, so that every open bag is completed."""


def parser(name: str, description: str, example: str = "") -> argparse.ArgumentParser:
    """Build the option parser of program `name`.

    `description` and `example` keep their line breaks in ``--help``.
    """
    result = argparse.ArgumentParser(
        prog=name,
        description=description,
        epilog=f"example:\n  {example}" if example else None,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    result.set_defaults(program_name=name)
    return result


def run(body: Callable[[argparse.Namespace], int | None], args: argparse.Namespace) -> int:
    """Run a program's body and turn its end into an exit status.

    Parameters
    ----------
    body
        Does the work; its return value is the exit status (None means 0).
    args
        Parsed options, handed to `body`. `args.program_name` (set by `parser`) heads every line
        on stderr.

    Returns
    -------
    int
        The body's status; 2 after bad input or a file-system error, 130 after Ctrl-C, 143 after
        SIGTERM. Anything else that the body raises is a defect and keeps its traceback.

    """
    name = getattr(args, "program_name", Path(sys.argv[0]).name)
    logging.basicConfig(format=f"{name}: %(levelname)s: %(message)s")
    try:
        previous = signal.signal(signal.SIGTERM, _raise_terminated)
    except ValueError:  # not in the main thread: whoever runs us keeps the signals
        previous = None
    try:
        return body(args) or 0
    except InputError as error:
        print(f"{name}: error: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except BrokenPipeError:  # `... | head`: the reader has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        print(f"{name}: error: {place}{error.strerror or error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except KeyboardInterrupt:
        print(f"{name}: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except Terminated:
        print(f"{name}: terminated", file=sys.stderr)
        return EXIT_TERMINATED
    finally:
        if previous is not None:
            signal.signal(signal.SIGTERM, previous)


def _raise_terminated(_signal: int, _frame: object) -> NoReturn:
    raise Terminated
