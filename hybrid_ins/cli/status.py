"""
The program ``ins_status``: what ``/diagnostics`` and ``gnss/verdict`` say, on one screen.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from collections.abc import Sequence

from hybrid_ins.cli import options, program
from hybrid_ins.ros.status_listener import StatusListener

CLEAR = "\x1b[H\x1b[J"
REFRESH = 1.0  # s
NOTHING_HEARD = 1


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program."""
    words = list(sys.argv[1:] if argv is None else argv)
    split = words.index("--ros-args") if "--ros-args" in words else len(words)
    parser = program.parser(
        "ins_status",
        "Show what a running ins_node says of itself: state, rejected input, noise, clock, fixes.\n"
        "The screen is refreshed every second, until Ctrl-C. With --once or --json the exit status "
        "is\n0 when the node has been heard, and 1 when not.",
        "ins_status --once --json | jq .statuses.filter.values.sigma_heading_deg",
    )
    parser.add_argument("--once", action="store_true", help="print the next diagnostics, and end")
    parser.add_argument(
        "--json", action="store_true", help="print JSON: an object, with --once; otherwise lines"
    )
    parser.add_argument(
        "--wait",
        type=options.positive,
        default=5.0,
        metavar="S",
        help="with --once, wait at most S seconds (default 5)",
    )
    parser.add_argument(
        "--namespace", default="/", metavar="NS", help="namespace of the node (default /)"
    )
    parser.set_defaults(ros_args=words[split:])
    return program.run(_run, parser.parse_args(words[:split]))


def _run(args: argparse.Namespace) -> int:
    listener = StatusListener(args.namespace, args.ros_args)
    status = listener.status
    try:
        if args.once:
            listener.listen(args.wait, lambda: bool(status.statuses))
            listener.listen(REFRESH, lambda: bool(status.verdicts))
            print(
                json.dumps(status.as_dict(), indent=2)
                if args.json
                else status.as_text(listener.age, _width())
            )
            return 0 if status.statuses else NOTHING_HEARD
        while program.is_read():
            listener.listen(REFRESH)
            if args.json:
                print(json.dumps(status.as_dict()), flush=True)
            else:
                clear = CLEAR if sys.stdout.isatty() else ""
                print(f"{clear}{status.as_text(listener.age, _width())}", flush=True)
        return 0
    finally:
        listener.close()


def _width() -> int:
    return shutil.get_terminal_size((100, 24)).columns


if __name__ == "__main__":
    raise SystemExit(main())
