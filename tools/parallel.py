"""One function over many arguments, on several processors of this machine."""

from __future__ import annotations

import argparse
import multiprocessing
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from itertools import starmap
from typing import Any, TypeVar

from hybrid_ins import progress
from hybrid_ins.cli import options

T = TypeVar("T")


def add_jobs(parser: argparse.ArgumentParser, default: int) -> None:
    """Add the option ``--jobs`` of `run_parallel`."""
    parser.add_argument(
        "--jobs",
        type=options.positive_count,
        default=default,
        metavar="N",
        help="processes [%(default)s]",
    )


def run_parallel(
    function: Callable[..., T], arguments: Iterable[tuple[Any, ...]], jobs: int
) -> Iterator[T]:
    """
    Yield ``function(*words)`` for each tuple of words, in their order.

    Parameters
    ----------
    function : callable
        Of a module, so that another process can import it.
    arguments : iterable of tuple
        Of values that can be pickled.
    jobs : int
        Processes; 1 stays in this one.
    """
    if jobs == 1:
        yield from starmap(function, arguments)
        return
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, spawn, initializer=progress.hide) as pool:
        futures = [pool.submit(function, *words) for words in arguments]
        try:
            for future in futures:
                yield future.result()
        finally:
            pool.shutdown(cancel_futures=True)
