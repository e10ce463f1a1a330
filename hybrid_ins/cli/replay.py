"""
``ins_replay``: the node's estimator over a recording, without middleware and at file speed.

Messages are taken in the order in which they were recorded, IMU samples in stretches between the
others; the same recording and parameters give the same bytes.
"""

from __future__ import annotations

import argparse
import sys
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from hybrid_ins import kernels
from hybrid_ins.bags.messages import FIX, INITIAL_POSE, TRANSFORMS, VELOCITY
from hybrid_ins.bags.reader import BagReader
from hybrid_ins.bags.writer import BagWriter
from hybrid_ins.cli import batch, options, program
from hybrid_ins.errors import InputError
from hybrid_ins.parameters import Values
from hybrid_ins.plotting import style
from hybrid_ins.plotting.overview import plot_bag
from hybrid_ins.ros.cdr import OdometryEncoder
from hybrid_ins.ros.conversions import OUTPUTS, Message
from hybrid_ins.ros.estimator import Estimator
from hybrid_ins.ros.rate_limiter import RateLimiter

TRUTH = "/truth/"
BLOCK = 256  # messages of one topic that are written at a time


def replay(
    bag: BagReader,
    out: BagWriter,
    values: Mapping[str, Any],
    *,
    imu_topic: str = "/imu/data",
    fix_topic: str = "/gnss/fix",
    velocity_topic: str = "/gnss/velocity",
    log: Callable[[str, str], None] | None = None,
    progress: bool = True,
) -> Estimator:
    """
    Run an estimator over a recording and write what it says.

    Parameters
    ----------
    bag, out : BagReader, BagWriter
        Input; output, on the node's topic names, with the fixes and any truth carried over.
    values : mapping
        Checked parameters.
    imu_topic, fix_topic, velocity_topic : str
        Where the input is.
    log : callable, optional
        Told what the estimator has to say, see there; by default stderr is.
    progress : bool
        Show a bar on a terminal.

    Returns
    -------
    Estimator
        In its last state.

    Raises
    ------
    InputError
        A topic is missing or of another type.
    """
    imu = bag.imu(imu_topic)
    order = np.arange(len(imu.stamp_ns))
    stamps_ns = imu.log_ns if values["use_receive_time"] else imu.stamp_ns
    fix_topic = bag.require(fix_topic, FIX, "--fix-topic")
    kernels.prepare(partial(log or _say, "info"))
    estimator = Estimator(values, log or _say)
    there = imu.has_reading
    estimator.foresee(stamps_ns[there], imu.specific_force[there], imu.angular_rate[there])
    writers = [
        _OdometryWriter(out, values, topic, values[frame])
        for topic, frame in (("/odometry", "map_frame"), ("/odometry/local", "odom_frame"))
    ]
    handlers: dict[str, Callable[[Message, int], None]] = {fix_topic: estimator.fix}
    if bag.topics.get(velocity_topic) == VELOCITY:
        handlers[velocity_topic] = estimator.velocity
    if bag.topics.get("/initialpose") == INITIAL_POSE:
        handlers["/initialpose"] = lambda message, _: estimator.initial_pose(message)
    if bag.topics.get("/tf_static") == TRANSFORMS:
        handlers["/tf_static"] = lambda message, _: estimator.static_transforms(message)
    frames = deque(imu.frames)

    def flush(log_ns: int) -> None:
        while estimator.outbox:
            topic, data = estimator.outbox.popleft()
            out.write_raw("/" + topic.lstrip("/"), OUTPUTS[topic], data, log_ns)

    def run(stretch: slice) -> None:
        while frames and frames[0][0] < stretch.stop:
            row, name = frames.popleft()
            if row > stretch.start:
                run(slice(stretch.start, row))
            estimator.take_frame("imu/data", name)
            stretch = slice(row, stretch.stop)
        rows = order[stretch]
        for _ in range(len(rows) - np.count_nonzero(imu.has_reading[stretch])):
            estimator.imu_without_reading()
        rows = rows[imu.has_reading[stretch]]
        for stamps, *values_by_frame in estimator.imu_block(
            stamps_ns[rows],
            imu.specific_force[rows],
            imu.angular_rate[rows],
            imu.orientation_xyzw[rows],
        ):
            for writer, odometry in zip(writers, values_by_frame, strict=True):
                writer.write(stamps, odometry)
        flush(int(imu.stamp_ns[max(stretch.stop, 1) - 1]))
        bar.update(stretch.stop - stretch.start)

    named = {topic: topic for topic in bag.topics if topic.startswith(TRUTH)}
    named[fix_topic] = "/gnss/fix"
    if velocity_topic in handlers:
        named[velocity_topic] = "/gnss/velocity"
    carried = {topic: _Carrier(out, name, bag.topics[topic]) for topic, name in named.items()}
    start, total = 0, len(imu.log_ns)
    hidden = None if progress else True
    with tqdm(total=total, desc="replay", unit="sample", unit_scale=True, disable=hidden) as bar:
        for topic, log_ns, data in bag.raw(*handlers, *carried):
            if topic in handlers:
                stop = max(start, int(np.searchsorted(imu.log_ns, log_ns, side="right")))
                run(slice(start, stop))
                start = stop
                handlers[topic](bag.decode(topic, log_ns, data), log_ns)
                flush(log_ns)
            if topic in carried:
                carried[topic].write(data, log_ns)
        run(slice(start, total))
    for writer in writers:
        writer.flush()
    for carrier in carried.values():
        carrier.flush()
    return estimator


class _OdometryWriter:
    """Writes odometry of one frame at the rate that the parameters ask for, many at a time."""

    def __init__(self, out: BagWriter, values: Mapping[str, Any], topic: str, frame: str) -> None:
        self._out = out
        self._topic = topic
        self._encoder = OdometryEncoder(frame, values["base_frame"])
        self._cadence = RateLimiter(values["odometry_rate"]) if values["odometry_rate"] else None
        self._waiting: list[tuple[NDArray[np.int64], NDArray[np.float64]]] = []
        self._count = 0

    def write(self, stamps: NDArray[np.int64], values: NDArray[np.float64]) -> None:
        """Take odometry; it is written with what follows it closely."""
        if self._cadence is not None:
            due = [k for k, t_ns in enumerate(stamps.tolist()) if self._cadence.is_due(t_ns)]
            stamps, values = stamps[due], values[due]
        self._waiting.append((stamps, values))
        self._count += len(stamps)
        if self._count >= BLOCK:
            self.flush()

    def flush(self) -> None:
        """Write what has been taken so far."""
        if self._count:
            stamps, values = map(np.concatenate, zip(*self._waiting, strict=True))
            rows = self._encoder.messages(stamps, values)
            self._out.write_rows(self._topic, OUTPUTS["odometry"], rows, stamps)
        self._waiting.clear()
        self._count = 0


class _Carrier:
    """Carries messages of one topic over from bag to bag, many at a time."""

    def __init__(self, out: BagWriter, topic: str, type_name: str) -> None:
        self._out = out
        self._topic = topic
        self._type_name = type_name
        self._messages: list[bytes] = []
        self._log_ns: list[int] = []

    def write(self, data: bytes, log_ns: int) -> None:
        """Take a message; it is written with what follows it closely."""
        self._messages.append(data)
        self._log_ns.append(log_ns)
        if len(self._messages) == BLOCK:
            self.flush()

    def flush(self) -> None:
        """Write what has been taken so far."""
        self._out.write_many(self._topic, self._type_name, self._messages, self._log_ns)
        self._messages.clear()
        self._log_ns.clear()


def _say(level: str, text: str) -> None:
    tqdm.write(f"ins_replay: {level}: {text}", file=sys.stderr)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program."""
    parser = program.parser(
        "ins_replay",
        "Estimate a recorded run: IMU and GNSS from a bag (rosbag2 MCAP or SQLite, ROS 1) through\n"
        "the node's own estimator, without middleware, faster than real time and repeatably.\n"
        "The output bag holds the node's topics, the fixes and any truth: ready for ins_evaluate.",
        "ins_replay flight.mcap estimate.mcap --params-file params.yaml\n"
        "  ins_replay flights/ estimates/     all bags in a folder; again to resume",
    )
    parser.add_argument(
        "input",
        metavar="IN",
        nargs="+",
        type=Path,
        help="bag with sensor_msgs/Imu and NavSatFix; several, or a folder of bags",
    )
    parser.add_argument(
        "output",
        metavar="OUT",
        type=Path,
        help="bag to write (directory, or *.mcap file); the folder for several",
    )
    options.add_parameters(parser, "parameter file, the same as the node's")
    options.add_topics(parser)
    parser.add_argument("--overwrite", action="store_true", help="replace OUT")
    parser.add_argument(
        "--plot",
        metavar="FILE",
        type=Path,
        help="draw the run, with errors where IN holds truth: .png or .svg",
    )
    batch.add_options(parser)
    return program.run(_body, parser.parse_args(argv))


def _body(args: argparse.Namespace) -> int:
    if args.plot is not None:
        style.check(args.plot)
    values, topics = options.parameter_values(args), options.topics(args)
    if len(args.input) > 1 or not batch.is_bag(args.input[0]):
        if args.plot is not None:
            raise InputError("--plot is for one bag at a time")
        kernels.prepare(partial(_say, "info"))
        return batch.run(
            args,
            batch.find_jobs(args.input, args.output),
            partial(_replay_one, values, topics, args.overwrite),
            {"values": values, "topics": topics},
            args.overwrite,
        )
    [source] = args.input
    with BagReader(source) as bag, BagWriter(args.output, overwrite=args.overwrite) as out:
        estimator = replay(bag, out, values, **topics)
    if not estimator.ever_aligned:
        raise InputError(
            f"{source}: the filter never started: it waited for "
            f"{estimator.navigator.waiting_for}; {args.output} holds no odometry"
        )
    print(estimator.summary())
    if args.plot is not None:
        plot_bag(args.output, args.plot)
        print(f"picture: {args.plot}")
    return 0


def _replay_one(
    values: Values, topics: options.InputTopics, overwrite: bool, job: batch.Job
) -> batch.Row:
    """Replay one bag of many; its output appears under its name once it is complete."""
    assert job.record is not None
    target = job.record.with_suffix(".mcap")
    if target.exists() and not job.record.exists() and not overwrite:
        raise InputError(f"{target} exists, but no record of its making: --overwrite to replace it")
    unfinished = target.with_name(f".{target.name}")
    remarks: list[str] = []
    with BagReader(job.source) as bag, BagWriter(unfinished, overwrite=True) as out:
        estimator = replay(
            bag,
            out,
            values,
            **topics,
            progress=False,
            log=lambda level, text: remarks.append(level),
        )
        duration = (bag.end_ns - bag.start_ns) * 1e-9
    if not estimator.ever_aligned:
        unfinished.unlink()
        raise InputError(
            f"the filter never started: it waited for {estimator.navigator.waiting_for}"
        )
    unfinished.replace(target)
    refused = sum(estimator.counts.values())
    return {
        "duration [s]": duration,
        "fixes fused": estimator.fixes_fused,
        "refused or remarkable": refused,
        "warnings": remarks.count("warn"),
    }
