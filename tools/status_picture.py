"""
Draw `docs/figures/status.png`: ``ins_status`` while a recorded flight is played into the node.

    python -m tools.status_picture --flight quadrotor/Horizontal/path_4

The flight is converted, calibrated and played into an ``ins_node`` in a ROS domain of its own, as
`tools/demo.sh` does it. The picture is the text that ``ins_status`` prints, drawn as a terminal
shows it.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from hybrid_ins.cli import options
from hybrid_ins.cli import program as shell
from hybrid_ins.errors import InputError
from hybrid_ins.output_file import check_output
from tools.processes import Processes, isolated_ros, program

PICTURE = Path(__file__).resolve().parents[1] / "docs" / "figures" / "status.png"
WIDTH = 100  # columns of the terminal
PATIENCE = 300.0  # s, for the node to be ready: the first start compiles
FONT_SIZE, LINE_HEIGHT, CHARACTER, MARGIN = 9.0, 0.18, 0.0752, 0.2  # points; inches
BACKGROUND, TEXT = "#1e1e1e", "#d4d4d4"
COLOURS = {"OK": "#6a9955", "WARN": "#d7ba7d", "ERROR": "#f44747"}


def main(argv: Sequence[str] | None = None) -> int:
    """Draw the picture and print the text."""
    parser = shell.parser("status_picture", __doc__ or "")
    parser.add_argument(
        "--flight", type=options.path, required=True, metavar="DIR", help="a flight of that dataset"
    )
    parser.add_argument(
        "--out", type=options.path, default=PICTURE, metavar="FILE", help="[%(default)s]"
    )
    parser.add_argument(
        "--after",
        type=options.not_negative,
        default=30.0,
        metavar="S",
        help="of the flight [%(default)g s]",
    )
    return shell.run(_body, parser.parse_args(argv))


def _body(args: argparse.Namespace) -> int:
    check_output(args.out, overwrite=True)
    os.environ.update(isolated_ros(), COLUMNS=str(WIDTH), PYTHONUNBUFFERED="1")
    with tempfile.TemporaryDirectory() as folder, Processes() as processes:
        text = status_in_flight(processes, args.flight, args.after, Path(folder))
    print(text)
    draw(text, args.out)
    return 0


def status_in_flight(processes: Processes, flight: Path, after: float, folder: Path) -> str:
    """Return the screen of ``ins_status`` some seconds after the playing has begun."""
    bag, calibrated = folder / "flight", folder / "calibrated.yaml"
    for command in (
        [program("ins_convert"), flight, bag],
        [program("ins_calibrate"), bag, "--out", calibrated],
    ):
        if subprocess.run(command, check=False).returncode:  # it has said why
            raise InputError(f"--flight {flight}: cannot be used")
    log, screens = folder / "node.log", folder / "screens.txt"
    with log.open("w") as output:
        node = [program("ins_node"), "--ros-args", "--params-file", calibrated]
        processes.start(node, output)
    end = time.monotonic() + PATIENCE
    while "ready" not in log.read_text():
        if time.monotonic() > end:
            raise InputError(f"no node is ready: {log.read_text()}")
        time.sleep(0.1)
    with screens.open("w") as output:
        processes.start([program("ins_status")], output)
    processes.start([program("ins_play"), bag], subprocess.DEVNULL)
    time.sleep(after)
    return "hybrid_ins:" + screens.read_text().rpartition("\nhybrid_ins:")[2].rstrip()


def draw(text: str, out: Path) -> None:
    """Write a picture of a terminal's text; levels have their usual colours."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    lines = ["$ ins_status", *text.splitlines()]
    width = CHARACTER * max(map(len, lines)) + 2.0 * MARGIN
    height = LINE_HEIGHT * len(lines) + 2.0 * MARGIN
    figure = pyplot.figure(figsize=(width, height), facecolor=BACKGROUND)
    for number, line in enumerate(lines):
        words = line.replace(",", " ").split()[:3]
        level = next((level for level in COLOURS if level in words), None)
        figure.text(
            MARGIN / width,
            1.0 - (MARGIN + LINE_HEIGHT * (number + 0.75)) / height,
            line.replace("$", r"\$"),
            family="DejaVu Sans Mono",
            size=FONT_SIZE,
            color=TEXT if level is None else COLOURS[level],
        )
    figure.savefig(out, dpi=120, facecolor=BACKGROUND)


if __name__ == "__main__":
    sys.exit(main())
