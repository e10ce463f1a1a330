"""The main job, end to end: a flight into the live node over DDS, and how well it estimated."""

from __future__ import annotations

import argparse
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from hybrid_ins.cli.options import positive
from hybrid_ins.kernels import is_compiled
from hybrid_ins.resources import share_path
from tools.processes import Processes, isolated_ros, program

LOG_LINES = 12  # of the node, shown when it fails
PATIENCE = 60.0  # s, for the node to come up


class Failed(Exception):
    """A step of the demo did not succeed; its text is one line for the user."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the demo and return its exit status."""
    args = parse(argv)
    signal.signal(signal.SIGTERM, _terminate)
    os.environ.update(isolated_ros())
    os.environ["PYTHONUNBUFFERED"] = "1"  # the node's last words, however it ends
    try:
        with Processes() as processes:
            fly(args, processes)
    except Failed as failure:
        print(f"tools/demo.sh: error: {failure}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("tools/demo.sh: interrupted", file=sys.stderr)
        return 130
    return 0


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    """Read the options."""
    parser = argparse.ArgumentParser(
        prog="tools/demo.sh",
        description="Play a flight into ins_node over DDS, record what it publishes, and score\n"
        "it against the truth. Without --flight the flight is simulated: 60 s of a quadrotor\n"
        "with a 1 kHz MPU-9250 and a 5 Hz GNSS receiver. A recorded one is calibrated first.",
        epilog="example:\n  tools/demo.sh --flight quadrotor/Horizontal/path_4",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--flight", type=Path, metavar="DIR", help="a flight of the quadrotor dataset"
    )
    parser.add_argument(
        "--imu", type=int, default=1, metavar="K", help="which IMU of that flight [%(default)s]"
    )
    parser.add_argument(
        "--time-offset",
        type=float,
        metavar="S",
        help="IMU clock minus the flight's reference clock; given, nothing is calibrated",
    )
    parser.add_argument(
        "--params-file",
        type=Path,
        metavar="FILE",
        help="parameters of the node [config/default.yaml]",
    )
    parser.add_argument(
        "--out", type=Path, default=Path("demo"), metavar="DIR", help="results [%(default)s/]"
    )
    parser.add_argument(
        "--rate", type=positive, default=1.0, metavar="R", help="times real time [%(default)g]"
    )
    parser.add_argument(
        "--seed", type=int, default=0, metavar="N", help="of all simulated noise [%(default)s]"
    )
    args = parser.parse_args(argv)
    if args.time_offset is not None and not math.isfinite(args.time_offset):
        parser.error(f"--time-offset {args.time_offset}: no finite number")
    if args.flight and not args.flight.is_dir():
        parser.error(f"--flight {args.flight}: no such folder")
    args.params_file = args.params_file or share_path("config/default.yaml")
    if not args.params_file.is_file():
        parser.error(f"--params-file {args.params_file}: no such file")
    return args


def fly(args: argparse.Namespace, processes: Processes) -> None:
    """Make the bag, play it into the node, score what came out."""
    started = time.monotonic()
    flight, estimate = args.out / "flight", args.out / "estimate"
    picture, log = args.out / "picture.png", args.out / "node.log"
    args.out.mkdir(parents=True, exist_ok=True)
    for earlier in (flight, estimate):
        clear(earlier)

    compile_all = [sys.executable, "-m", "hybrid_ins.kernels"]
    compiling = None if is_compiled() else processes.start(compile_all)
    parameters = args.params_file
    if args.flight:
        step(1, f"convert {args.flight}")
        offset = ["--time-offset", args.time_offset or 0.0]
        run("ins_convert", args.flight, flight, "--imu", args.imu, "--seed", args.seed, *offset)
        if args.time_offset is None:
            print("calibrate: clock offset, where the IMU is, noise", flush=True)
            parameters = args.out / "calibrated.yaml"
            known = ["--params-file", args.params_file, "--out", parameters, "--overwrite"]
            run("ins_calibrate", flight, *known)
    else:
        step(1, "simulate a flight")
        run("ins_simulate", flight, "--seed", args.seed)
    if compiling is not None and compiling.poll() is None:
        print("compile the filter: once, the machine code is kept", flush=True)
        compiling.wait()

    step(2, f"play it into ins_node, at {args.rate:g} times real time")
    with log.open("w") as output:
        ros = ["--ros-args", "--params-file", parameters]
        node = processes.start([program("ins_node"), *map(str, ros)], output)
    play = ["--record", estimate, "--rate", args.rate, "--wait", PATIENCE]
    player = processes.start([program("ins_play"), flight, *map(str, play)])
    while player.poll() is None:
        if node.poll() is not None:
            raise Failed(f"ins_node ended early, with status {node.returncode}{last_words(log)}")
        time.sleep(0.05)
    if player.returncode:
        raise Failed(f"ins_play failed with status {player.returncode}{last_words(log)}")
    if status := processes.stop(node):
        raise Failed(f"ins_node did not end cleanly, status {status}{last_words(log)}")

    step(3, "compare with the truth")
    run("ins_evaluate", estimate, "--truth", flight, "--plot", picture, "--overwrite")

    print(f"\nDone in {time.monotonic() - started:.0f} s. Look at {picture}")
    print(f"bags: {flight} and {estimate}; what the node said: {log}")


def clear(bag: Path) -> None:
    """Remove the bag of an earlier demo, and nothing else."""
    if (bag / "metadata.yaml").is_file():
        shutil.rmtree(bag)
    elif bag.exists():
        raise Failed(f"{bag}: is there and is no bag of an earlier demo; choose another --out")


def step(number: int, text: str) -> None:
    """Say what happens now."""
    print(f"\n[{number}/3] {text}", flush=True)


def run(name: str, *options: object) -> None:
    """Run one of the package's programs to its end."""
    status = subprocess.run([program(name), *map(str, options)], check=False).returncode
    if status:
        raise Failed(f"{name} failed with status {status}")


def last_words(log: Path) -> str:
    """Return the end of the node's output, to be put after an error."""
    lines = log.read_text(errors="replace").splitlines()[-LOG_LINES:]
    return "".join(f"\n  {line}" for line in lines) or "; it said nothing"


def _terminate(_signal: int, _frame: object) -> NoReturn:
    raise SystemExit(143)  # unwinds, so that the children are stopped


if __name__ == "__main__":
    raise SystemExit(main())
