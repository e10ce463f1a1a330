"""Ctrl-C and SIGTERM as exceptions, so that what is open is completed or removed."""

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


class Terminated(BaseException):
    """SIGTERM: unwinds like Ctrl-C, so that every open bag is completed."""


@contextmanager
def raised(*, once: bool = False) -> Iterator[None]:
    """
    Within the block, Ctrl-C raises `KeyboardInterrupt`, and SIGTERM `Terminated`.

    Compiled code calls some functions of numba, and turns what is raised there into a SystemError;
    and Python ignores what is raised where an object ends, as in the callback of a weak reference.
    A signal that arrives there comes again.

    Parameters
    ----------
    once
        Ignore signals after the first, until the block ends.
    """
    timers: list[threading.Timer] = []
    kinds = {signal.SIGINT: KeyboardInterrupt, signal.SIGTERM: Terminated}

    def leave(number: int, frame: FrameType | None) -> None:
        if frame is None or frame.f_globals.get("__name__") != CALLED_BY_COMPILED_CODE:
            for other in previous if once else ():
                signal.signal(other, signal.SIG_IGN)
            raise kinds[signal.Signals(number)]
        come_again(number)

    def come_again(number: int) -> None:
        signal.signal(number, leave)
        timers.append(threading.Timer(AGAIN, os.kill, (os.getpid(), number)))
        timers[-1].start()

    def notice(unraisable: Any) -> None:
        number = next((n for n, kind in kinds.items() if unraisable.exc_type is kind), None)
        if number is None:
            previous_hook(unraisable)
        else:
            come_again(number)

    previous_hook = sys.unraisablehook
    previous = {number: signal.getsignal(number) for number in kinds}
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
