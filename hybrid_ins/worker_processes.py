"""Processes of this machine that work side by side."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager

from hybrid_ins import signals
from hybrid_ins.errors import InputError


@contextmanager
def worker_processes(count: int) -> Iterator[Executor]:
    """
    Yield so many processes; they end with the block, at once if it raises.

    What waits for one that is killed raises `BrokenProcessPool`; outside of the block that is an
    `InputError`.
    """
    context = multiprocessing.get_context("spawn")  # a fork would inherit locks and threads
    executor = ProcessPoolExecutor(count, context, initializer=_follow_the_parent)
    try:
        yield executor
    except BaseException as error:
        executor.shutdown(wait=False, cancel_futures=True)
        for process in multiprocessing.active_children():
            process.terminate()
        if isinstance(error, BrokenProcessPool):
            raise InputError(
                "a process of this program was killed, probably for want of memory: make room"
            ) from None
        raise
    finally:
        executor.shutdown()


@contextmanager
def ended_in_order() -> Iterator[None]:
    """
    Within the block, a signal first unwinds what such a process has open, and then ends it.

    Elsewhere, as in a thread or in the program's own process, the block is as any other.
    """
    if multiprocessing.parent_process() is None:
        yield
        return
    try:
        with signals.raised(once=True):
            yield
    except signals.Terminated as ended:
        os._exit(128 + ended.number)  # an exception would only end this piece of work


def _follow_the_parent() -> None:
    """
    Leave Ctrl-C and SIGHUP, which reach all processes of a terminal, to the one that started them.

    And end with that one, also where it is killed.
    """
    signals.leave_to_the_parent()
    threading.Thread(target=_end_with_the_parent, daemon=True).start()


def _end_with_the_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)
