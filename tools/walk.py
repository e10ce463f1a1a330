"""
A walk from its raw files to a smoothed, exported track in five commands, with their times.

Writes the transcript into ``docs/logs.md``, between its two marks, and the picture.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from hybrid_ins.cli import program
from hybrid_ins.errors import InputError

BEGIN, END = "<!-- walk: begin -->", "<!-- walk: end -->"
RAW = "imu_1730.csv", "gnss_1730_sf.pos"
COMMANDS = (
    f"ins_convert {RAW[0]} {RAW[1]} walk.mcap",
    "ins_calibrate walk.mcap --out walk.yaml",
    "ins_replay walk.mcap filtered.mcap --params-file walk.yaml",
    "ins_replay walk.mcap smoothed.mcap --params-file walk.yaml --smooth "
    "--export walk.kml --export walk.csv",
    "ins_evaluate filtered.mcap smoothed.mcap --no-truth --plot both.png",
)
PICTURE = "figures/walk_smoothed.png"
MOST_LINES = 30  # of what a command prints


def _cpu() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def run_commands(raw: Path, folder: Path) -> tuple[list[str], list[tuple[str, float, float]]]:
    """Run the commands in a folder; return what they print, and elapsed and CPU time of each."""
    for name in RAW:
        if not (raw / name).is_file():
            raise InputError(f"{raw}: holds no {name}: is this pedestrian_rtk/raw?")
        (folder / name).symlink_to((raw / name).resolve())
    printed: list[str] = []
    times = []
    for command in COMMANDS:
        began, cpu = time.monotonic(), _cpu()
        name, *arguments = command.split()
        module = f"hybrid_ins.cli.{name.removeprefix('ins_')}"
        done = subprocess.run(
            [sys.executable, "-m", module, *arguments],
            cwd=folder,
            capture_output=True,
            text=True,
            check=False,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        )
        if done.returncode:
            raise InputError(f"{command}: {done.stderr.strip() or done.stdout.strip()}")
        times.append((command, time.monotonic() - began, _cpu() - cpu))
        printed += [f"$ {command}", *done.stdout.rstrip().splitlines()[:MOST_LINES]]
    return printed, times


def section(printed: Sequence[str], times: Sequence[tuple[str, float, float]]) -> str:
    """Return the table of times and the transcript."""
    load = os.getloadavg()[0] / (os.cpu_count() or 1)
    rows = [f"| `{command}` | {wall:.1f} | {cpu:.1f} |" for command, wall, cpu in times]
    total = [sum(column) for column in list(zip(*times, strict=True))[1:]]
    return "\n".join(
        (
            BEGIN,
            f"Made by `python -m tools.walk --data RAW`; {load:.1f} processes for each core of the "
            "machine.",
            "",
            "| command | elapsed [s] | processor [s] |",
            "|---|---|---|",
            *rows,
            f"| together | {total[0]:.0f} | {total[1]:.0f} |",
            "",
            *(f"    {line}".rstrip() for line in printed),
            "",
            END,
        )
    )


def _body(args: argparse.Namespace) -> int:
    target = args.out / "logs.md"
    text = target.read_text(encoding="utf-8")
    if BEGIN not in text or END not in text:
        raise InputError(f"{target}: has no marks {BEGIN} and {END}")
    with tempfile.TemporaryDirectory() as name:
        printed, times = run_commands(args.data, Path(name))
        picture = (Path(name) / "both.png").read_bytes()
    (args.out / PICTURE).write_bytes(picture)
    head, tail = text[: text.index(BEGIN)], text[text.index(END) + len(END) :]
    target.write_text(head + section(printed, times) + tail, encoding="utf-8")
    print(target)
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program."""
    parser = program.parser(
        "walk", __doc__ or "", "python -m tools.walk --data vehicles/pedestrian_rtk/raw"
    )
    parser.add_argument("--data", type=Path, required=True, metavar="DIR", help="the raw files")
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder to write to [docs]")
    return program.run(_body, parser.parse_args(argv))


if __name__ == "__main__":
    sys.exit(main())
