"""Option values that several programs take, checked as they are read."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from typing import Any

from hybrid_ins.errors import InputError


def number(text: str) -> float:
    """Read a finite number."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text!r} is no number")
    return value


def not_negative(text: str) -> float:
    """Read a number that is zero or more."""
    value = number(text)
    if value < 0.0:
        raise argparse.ArgumentTypeError(f"{text} is negative")
    return value


def positive(text: str) -> float:
    """Read a number above zero."""
    value = number(text)
    if value <= 0.0:
        raise argparse.ArgumentTypeError(f"{text} is not above zero")
    return value


def count(text: str) -> int:
    """Read a whole number that is zero or more."""
    if not (text.isascii() and text.isdigit()):
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number from zero on")
    return int(text)


def add_gnss_noise(parser: Any, default: Sequence[float]) -> None:
    """Add ``--gnss-noise`` to a parser or a group of one."""
    parser.add_argument(
        "--gnss-noise",
        type=not_negative,
        nargs=3,
        default=default,
        metavar=("SN", "SE", "SD"),
        help="standard deviations north, east, down, m [0.1 0.1 0.1414]",
    )


def add_outage(parser: Any) -> None:
    """Add ``--outage`` to a parser or a group of one."""
    parser.add_argument(
        "--outage",
        type=number,
        nargs=2,
        action="append",
        default=[],
        metavar=("START", "DURATION"),
        help="no fixes for DURATION from START after the bag's beginning, s; may be repeated",
    )


def outages(given: Sequence[Sequence[float]]) -> list[tuple[float, float]]:
    """
    Check what ``--outage`` was given: pairs of start and duration [s].

    Raises
    ------
    InputError
        A duration is not above zero.

    """
    for start, duration in given:
        if duration <= 0.0:
            raise InputError(f"--outage {start:g} {duration:g}: the duration is not above zero")
    return [(start, duration) for start, duration in given]
