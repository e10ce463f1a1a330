"""Signals that end a program as exceptions, so that what is open is completed or removed."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

CALLED_BY_COMPILED_CODE = "numba.core.serialize"
AGAIN = 0.01  # s, after which a signal comes again


def that_end() -> list[signal.Signals]:
    """Return the signals that end a program: SIGHUP, of a terminal that closes, unless ignored."""
    is_kept = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN  # by ``nohup``
    return [signal.SIGINT, signal.SIGTERM, *([] if is_kept else [signal.SIGHUP])]


def leave_to_the_parent() -> None:
    """Ignore Ctrl-C and SIGHUP, which reach all processes of a terminal."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)


class Terminated(BaseException):
    """
    SIGTERM or SIGHUP: unwinds like Ctrl-C, so that every open bag is completed.

    Parameters
    ----------
    number : int
        Of the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number


@contextmanager
def raised(*, once: bool = False) -> Iterator[None]:
    """
    Within the block, Ctrl-C raises `KeyboardInterrupt`, SIGTERM and SIGHUP `Terminated`.

    Compiled code calls some functions of numba, and turns what is raised there into a SystemError;
    and Python ignores what is raised where an object ends, as in the callback of a weak reference.
    A signal that arrives there comes again.

    Parameters
    ----------
    once
        Ignore signals after the first, until the block ends.
    """
    timers: list[threading.Timer] = []

    def leave(number: int, frame: FrameType | None) -> None:
        if frame is None or frame.f_globals.get("__name__") != CALLED_BY_COMPILED_CODE:
            for other in previous if once else ():
                signal.signal(other, signal.SIG_IGN)
            raise KeyboardInterrupt if number == signal.SIGINT else Terminated(number)
        come_again(number)

    def come_again(number: int) -> None:
        signal.signal(number, leave)
        timers.append(threading.Timer(AGAIN, os.kill, (os.getpid(), number)))
        timers[-1].start()

    def notice(unraisable: Any) -> None:
        if unraisable.exc_type is KeyboardInterrupt:
            come_again(signal.SIGINT)
        elif isinstance(unraisable.exc_value, Terminated):
            come_again(unraisable.exc_value.number)
        else:
            previous_hook(unraisable)

    previous_hook = sys.unraisablehook
    previous: dict[int, Any] = {number: signal.getsignal(number) for number in that_end()}
    if threading.current_thread() is not threading.main_thread():
        previous = {}  # whoever runs us keeps the signals
    elif previous[signal.SIGINT] is not signal.default_int_handler:
        del previous[signal.SIGINT]  # ignored, as behind `&` of a shell
    for number in previous:
        signal.signal(number, leave)
    if previous:
        sys.unraisablehook = notice
    try:
        yield
    finally:
        sys.unraisablehook = previous_hook
        for timer in timers:
            timer.cancel()
        for number, handler in previous.items():
            signal.signal(number, handler)
