"""Processes of this machine that work side by side."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager

from hybrid_ins.errors import InputError


@contextmanager
def worker_processes(count: int) -> Iterator[Executor]:
    """
    Yield so many processes; they end with the block, at once if it raises.

    What waits for one that is killed raises `BrokenProcessPool`; outside of the block that is an
    `InputError`.
    """
    context = multiprocessing.get_context("spawn")  # a fork would inherit locks and threads
    executor = ProcessPoolExecutor(count, context, initializer=_ignore_ctrl_c)
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


def _ignore_ctrl_c() -> None:
    """Leave Ctrl-C, which reaches all processes of a terminal, to the one that started them."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
