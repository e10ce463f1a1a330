"""
Hours of recorded time through the live node: memory, lost messages, latency.

A long simulated drive is played over DDS faster than real time. The node's memory is read from the
kernel, lost samples from its own count in ``/diagnostics``, latency from when its odometry comes
back.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hybrid_ins.bags.reader import BagReader
from hybrid_ins.cli import options
from hybrid_ins.cli import program as shell
from hybrid_ins.ros.messages.conversions import stamp_ns
from tools.processes import Processes, isolated_ros, program

SETTLED = 0.1  # share of the run after which memory counts
GROWTH = 0.05  # that is called flat
WATCH = 2.0  # s


def resident(pid: int) -> float:
    """Memory that a process holds [MB]."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1]) / 1024.0
    return 0.0


def main(argv: Sequence[str] | None = None) -> int:
    """Run it."""
    parser = shell.parser("soak", __doc__ or "")
    parser.add_argument(
        "--hours", type=options.positive, default=2.0, metavar="H", help="[%(default)s]"
    )
    parser.add_argument(
        "--rate",
        type=options.positive,
        default=10.0,
        metavar="R",
        help="times real time [%(default)g]",
    )
    parser.add_argument(
        "--imu-rate", type=options.positive, default=200.0, metavar="HZ", help="[%(default)g]"
    )
    parser.add_argument(
        "--bag", type=options.path, metavar="BAG", help="play this one instead, or make it there"
    )
    return shell.run(_body, parser.parse_args(argv))


def _body(args: argparse.Namespace) -> int:
    os.environ.update(isolated_ros())
    with tempfile.TemporaryDirectory() as folder, Processes() as processes:
        bag, out, log = (
            args.bag or Path(folder) / "drive.mcap",
            Path(folder) / "out.mcap",
            (Path(folder) / "node.log"),
        )
        if not bag.exists():
            made = processes.start(
                [
                    program("ins_simulate"),
                    bag,
                    "--trajectory",
                    "car",
                    "--duration",
                    str(3600.0 * args.hours),
                    "--imu-rate",
                    str(args.imu_rate),
                    "--truth-rate",
                    "0.1",
                ]
            )
            if made.wait():
                return 1
        with BagReader(bag) as reader:
            played = reader.count("/imu/data")
            seconds = (reader.end_ns - reader.start_ns) * 1e-9
        with log.open("w") as output:
            node = processes.start(
                [program("ins_node"), "--ros-args", "-p", "odometry_rate:=5.0"], output
            )
            player = processes.start(
                [
                    program("ins_play"),
                    bag,
                    "--rate",
                    str(args.rate),
                    "--wait",
                    "120",
                    "--record",
                    out,
                    "--record-topics",
                    "/odometry",
                    "/diagnostics",
                ],
                output,
            )
            memory = []
            while player.poll() is None and node.poll() is None:
                memory.append(resident(node.pid))
                time.sleep(WATCH)
            status = processes.stop(node)
        words = log.read_text(errors="replace")
        delays, taken = [], 0
        with BagReader(out) as reader:
            for topic, log_ns, message in reader.messages("/odometry", "/diagnostics"):
                if topic == "/odometry":
                    delays.append((log_ns - stamp_ns(message.header.stamp)) * 1e-6 / args.rate)
                else:
                    for item in (i for s in message.status for i in s.values):
                        taken = int(item.value) if item.key == "imu_samples" else taken
        settled = memory[int(SETTLED * len(memory)) :]
        lost = played - taken
        print(
            f"{seconds / 3600.0:.2f} h of recorded time at {args.rate:g} times real time, "
            f"{played} IMU messages, {len(delays)} odometry messages; exit status {status}"
        )
        print(
            f"memory: first {settled[0]:.1f} MB, last {settled[-1]:.1f} MB, "
            f"largest {max(settled):.1f} MB"
        )
        print(f"IMU messages not taken: {lost}")
        print(
            "latency: median {:.2f} ms, p99 {:.2f} ms, largest {:.1f} ms".format(
                *np.percentile(delays, [50, 99, 100])
            )
        )
        for line in words.splitlines():
            if "WARN" in line or "ERROR" in line or "Traceback" in line:
                print(line)
    # The samples after the last diagnostics message of the run are not counted in it.
    flat = settled[-1] < (1.0 + GROWTH) * settled[0]
    return int(bool(status) or not flat or lost > 2.0 * args.imu_rate or "Traceback" in words)


if __name__ == "__main__":
    raise SystemExit(main())
