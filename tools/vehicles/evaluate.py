"""
Table of vehicles, real and simulated: accuracy, consistency, share of fixes used, silent errors.

Real sets are read from a folder with one sub-folder per set, or are autopilots' logs; every second
fix, or all but one a second, is withheld and scored. Odd seeds of the simulated vehicles are for
tuning, even ones judge.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path

from hybrid_ins import parameters
from hybrid_ins.cli import options, program
from hybrid_ins.errors import InputError
from hybrid_ins.parameters import parameter_file
from hybrid_ins.simulation.vehicles import VEHICLES, record
from tools.vehicles.drives import AGE, Drive, Log, from_log, from_simulation, load, log
from tools.vehicles.judge import score

FEEDS = ("half", "1 Hz")
HEADER = (
    "| drive | aligned [s] | fixes used | RMSE, up [m] | NEES/2 | NIS/m | worst [m] "
    "| silently wrong [s] | heading [°] | offset [s] |\n" + "|---" * 10 + "|"
)


def drives(
    names: Sequence[str], seeds: Sequence[int], data: Path | None, logs: Sequence[Log] = ()
) -> Iterator[Drive]:
    """
    Return a generator of ``logs``, and of the drives with one of ``names`` in theirs.

    Without both it generates all.

    Raises
    ------
    InputError
        No drive has such a name, or there is no real set in the folder ``data``.
    """
    sets = {} if data is None else {name: data / name for name in real_sets(data)}
    feeds = [
        (name, feed) for name in sets for feed in (("all",) if name == "car_circles" else FEEDS)
    ]
    check_names(names, [*VEHICLES, *map(", ".join, feeds)])

    def wanted(name: str) -> bool:
        return not (names or logs) or any(part in name for part in names)

    simulated = [vehicle for name, vehicle in VEHICLES.items() if wanted(name)]
    return chain(
        (from_log(path, feed) for path in logs for feed in FEEDS),
        (from_simulation(record(vehicle, seed)) for vehicle in simulated for seed in seeds),
        (load(sets[name], feed) for name, feed in feeds if wanted(f"{name}, {feed}")),
    )


def real_sets(data: Path) -> list[str]:
    """Return the names of the real sets in a folder; `InputError` where it holds none."""
    found = [name for name in AGE if (data / name).is_dir()]
    if not found:
        raise InputError(f"{data}: holds none of the real sets {', '.join(AGE)}")
    return found


def check_names(parts: Sequence[str], names: Sequence[str]) -> None:
    """Raise `InputError` where one of the ``parts`` is in no name."""
    for part in parts:
        if not any(part in name for name in names):
            raise InputError(f"{part}: is not part of any name: {'; '.join(names)}")


def parser_of_drives(name: str, description: str | None) -> argparse.ArgumentParser:
    """Return the parser of program ``name`` with the options that `drives` needs."""
    parser = program.parser(name, description or "")
    parser.add_argument("names", nargs="*", metavar="NAME", help="parts of the drives' names")
    parser.add_argument("--seeds", type=options.count, nargs="+", default=[2, 4], metavar="N")
    parser.add_argument("--data", type=options.path, metavar="DIR", help="folder of the real sets")
    parser.add_argument(
        "--log",
        type=log,
        nargs="+",
        default=[],
        metavar="FILE",
        help="logs that ins_convert reads: of an autopilot, or IMU,GNSS",
    )
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = parser_of_drives("evaluate", __doc__)
    parser.add_argument("--params-file", type=options.path, metavar="FILE")
    return program.run(_body, parser.parse_args(argv))


def _body(args: argparse.Namespace) -> int:
    values = parameters.defaults()
    if args.params_file is not None:
        values = parameter_file.load(args.params_file)
    chosen = drives(args.names, args.seeds, args.data, args.log)
    print(HEADER)
    for drive in chosen:
        s = score(drive, values)
        print(
            f"| {drive.name} | {s.aligned:.0f} | {100.0 * s.used:.1f} % | {s.rmse:.3f}, "
            f"{s.rmse_up:.3f} | {s.nees:.2f} | {s.nis:.2f} | {s.worst:.2f} | {s.silent:.0f} "
            f"| {s.heading:.1f} | {s.offset:+.3f} |",
            flush=True,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
