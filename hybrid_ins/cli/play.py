"""
The program ``ins_play``: a recording published over DDS in real or scaled time, its echo recorded.

It stands in for ``ros2 bag play`` and ``ros2 bag record`` where ROS 2 is installed without rosbag2.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence

from hybrid_ins.bags.messages import absolute
from hybrid_ins.cli import options, program
from hybrid_ins.playback import ESTIMATES, Recording, Selection, play


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program."""
    words = list(sys.argv[1:] if argv is None else argv)
    split = words.index("--ros-args") if "--ros-args" in words else len(words)
    parser = _parser()
    parser.set_defaults(ros_args=words[split:])
    return program.run(_run, parser.parse_args(words[:split]))


def _parser() -> argparse.ArgumentParser:
    parser = program.parser(
        "ins_play",
        "Publish a recording over DDS in real or scaled time, with /clock in its time.\n"
        "Without --topics everything is published except /truth/* and what ins_node publishes.\n"
        "With --record what comes back is written to a bag, stamped in the recording's time.",
        "ins_play flight.mcap --rate 2 --record estimate.mcap",
    )
    add = parser.add_argument
    add("bag", type=options.path, metavar="IN", help="rosbag2 directory, .mcap, .db3 or ROS 1 .bag")
    add("--rate", type=options.positive, default=1.0, help="bag seconds per second (default 1)")
    add("--topics", nargs="+", metavar="T", help="publish these topics only")
    add(
        "--start",
        type=options.not_negative,
        default=0.0,
        metavar="S",
        help="skip the first S seconds",
    )
    add(
        "--duration",
        type=options.positive,
        default=math.inf,
        metavar="S",
        help="play S seconds only",
    )
    add(
        "--remap",
        nargs="+",
        action="extend",
        default=[],
        type=_remapping,
        metavar="A:=B",
        help="topic A of a bag is topic B of ROS, for playing and recording",
    )
    add("--no-clock", action="store_true", help="do not publish /clock")
    add(
        "--wait",
        type=options.not_negative,
        default=10.0,
        metavar="S",
        help="wait at most S seconds until every topic has its subscriber (default 10)",
    )
    add(
        "--record",
        type=options.path,
        metavar="OUT",
        help="write what is received: directory or .mcap",
    )
    add(
        "--record-topics",
        nargs="+",
        metavar="T",
        default=list(ESTIMATES),
        help="what to record (default: what ins_node publishes, except /tf)",
    )
    add("--overwrite", action="store_true", help="replace OUT if it exists")
    add(
        "--drain",
        type=options.not_negative,
        default=1.0,
        metavar="S",
        help="continue for S seconds after the last message, for the last answers (default 1)",
    )
    return parser


def _run(args: argparse.Namespace) -> None:
    selection = Selection(
        topics=args.topics,
        start=args.start,
        duration=args.duration,
        rate=args.rate,
        remap=dict(args.remap),
        clock=not args.no_clock,
        patience=args.wait,
        drain=args.drain,
    )
    recording = None
    if args.record is not None:
        recording = Recording(args.record, args.record_topics, args.overwrite)
    play(args.bag, selection, recording, args.ros_args)


def _remapping(text: str) -> tuple[str, str]:
    old, separator, new = text.partition(":=")
    if not (old and separator and new):
        raise argparse.ArgumentTypeError(f"{text} is not of the form old:=new")
    return absolute(old), absolute(new)


if __name__ == "__main__":
    raise SystemExit(main())
