"""Options that several programs share, with checks of their values."""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hybrid_ins import parameters
from hybrid_ins.bags.reader import InputTopics
from hybrid_ins.errors import InputError
from hybrid_ins.noise_regressor.reader import check_model
from hybrid_ins.parameters import parameter_file

LARGEST = 2.0**32  # s, the range of stamps; no other quantity needs more


def number(text: str) -> float:
    """Read a finite number, small enough to be counted in nanoseconds."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number")
    if abs(value) > LARGEST:
        raise argparse.ArgumentTypeError(f"{text} is too large: give {LARGEST:.2g} at most")
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
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least zero")
    return int(text)


def positive_count(text: str) -> int:
    """Read a whole number above zero."""
    value = count(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} is not above zero")
    return value


def path(text: str) -> Path:
    """Read the name of a file or folder; an empty one, of an unset variable, is not this folder."""
    if not text:
        raise argparse.ArgumentTypeError("'' is no name of a file or folder")
    return Path(text)


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


def add_parameters(parser: Any, what: str) -> None:
    """Add ``--params-file``, described as `what`, and ``--param``."""
    parser.add_argument("--params-file", metavar="F", help=f"{what} [the defaults]")
    parser.add_argument(
        "-p",
        "--param",
        metavar="NAME:=VALUE",
        action="append",
        default=[],
        help="set one parameter; overrides the file; may be repeated",
    )


def parameter_values(args: argparse.Namespace) -> parameters.Values:
    """
    Return checked parameters of ``--params-file`` and ``--param``.

    Raises
    ------
    InputError
        See `parameter_file.load`; an override is not ``name:=value``; or there is no such
        ``noise.model``.

    """
    values: dict[str, Any] = {}
    if args.params_file:
        values.update(parameter_file.load(args.params_file))
    for text in args.param:
        name, separator, value = text.partition(":=")
        if not separator:
            raise InputError(f"--param {text}: write NAME:=VALUE, e.g. -p gnss.patience:=5.0")
        values[name] = parameters.parse_value(name, value)
    checked = parameters.check_all(values)
    check_model(checked)
    return checked


def add_topics(parser: Any) -> None:
    """Add the names of the topics that a recording's input is on."""
    for name, default, note in (
        ("imu", "/imu/data", ""),
        ("fix", "/gnss/fix", ""),
        ("velocity", "/gnss/velocity", ", used where the bag has it"),
    ):
        parser.add_argument(
            f"--{name}-topic", metavar="T", default=default, help=f"[%(default)s]{note}"
        )


def topics(args: argparse.Namespace) -> InputTopics:
    """Return what `add_topics` was given."""
    return {
        "imu_topic": args.imu_topic,
        "fix_topic": args.fix_topic,
        "velocity_topic": args.velocity_topic,
    }


def add_batch(parser: argparse.ArgumentParser) -> Any:
    """Add the options of work on many bags; return their group."""
    group = parser.add_argument_group("many bags")
    group.add_argument(
        "--jobs",
        metavar="N",
        type=positive_count,
        default=os.cpu_count(),
        help="bags at a time [one for each of the %(default)s processors]",
    )
    group.add_argument(
        "--dask",
        metavar="ADDRESS",
        help="work on a Dask cluster, e.g. tcp://10.0.0.1:8786, whose workers see "
        "the same files, instead of on this machine",
    )
    return group
