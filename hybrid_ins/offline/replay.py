"""
``ins_replay``: the node's estimator over a recording, without middleware and at file speed.

Messages are taken in the order in which they were recorded, IMU samples in stretches between the
others; the same recording and parameters give the same bytes.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from hybrid_ins import parameters
from hybrid_ins.conversions import OUTPUTS, Message
from hybrid_ins.errors import InputError
from hybrid_ins.estimator import Estimator
from hybrid_ins.offline import program
from hybrid_ins.offline.bags import BagReader, BagWriter, ImuTable
from hybrid_ins.wire import OdometryEncoder

FIX = "sensor_msgs/msg/NavSatFix"
VELOCITY = "geometry_msgs/msg/TwistWithCovarianceStamped"
INITIAL_POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
CARRIED_OVER = ("/truth/odometry", "/truth/datum")


def replay(
    bag: BagReader,
    out: BagWriter,
    values: Mapping[str, Any],
    *,
    imu_topic: str = "/imu/data",
    fix_topic: str = "/gnss/fix",
    velocity_topic: str = "/gnss/velocity",
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
    fix_topic = bag.require(fix_topic, FIX, "--fix-topic")
    estimator = Estimator(values, _say)
    writer = _OdometryWriter(out, values)
    handlers = {fix_topic: estimator.fix}
    if bag.topics.get(velocity_topic) == VELOCITY:
        handlers[velocity_topic] = estimator.velocity
    if bag.topics.get("/initialpose") == INITIAL_POSE:
        handlers["/initialpose"] = estimator.initial_pose

    def flush(log_ns: int) -> None:
        while estimator.outbox:
            topic, data = estimator.outbox.popleft()
            out.write_raw("/" + topic.lstrip("/"), OUTPUTS[topic], data, log_ns)

    for stretch, item in _in_order(imu, bag.messages(*handlers)):
        for stamps, odometry in estimator.imu_block(
                imu.stamp_ns[stretch], imu.specific_force[stretch], imu.angular_rate[stretch]):
            writer.write(stamps, odometry)
        flush(int(imu.stamp_ns[max(stretch.stop, 1) - 1]))
        if item is not None:
            topic, log_ns, message = item
            handlers[topic](message)
            flush(log_ns)
    for topic, log_ns, data in bag.raw(fix_topic, *CARRIED_OVER):
        name = "/gnss/fix" if topic == fix_topic else topic
        out.write_raw(name, bag.topics[topic], data, log_ns)
    return estimator


def _in_order(
    imu: ImuTable, others: Iterator[tuple[str, int, Message]]
) -> Iterator[tuple[slice, tuple[str, int, Message] | None]]:
    """Yield stretches of IMU samples, each with the message that was recorded after it."""
    start, total = 0, len(imu.log_ns)
    with tqdm(total=total, desc="replay", unit="sample", unit_scale=True, disable=None) as bar:
        for item in others:
            stop = max(start, int(np.searchsorted(imu.log_ns, item[1], side="right")))
            yield slice(start, stop), item
            bar.update(stop - start)
            start = stop
        yield slice(start, total), None
        bar.update(total - start)


class _OdometryWriter:
    """Writes odometry at the rate that the parameters ask for."""

    def __init__(self, out: BagWriter, values: Mapping[str, Any]) -> None:
        self._out = out
        self._encoder = OdometryEncoder(values["map_frame"], values["base_frame"])
        rate = values["odometry_rate"]
        self._period_ns = int(1e9 / rate) if rate else 0
        self._next_ns = 0

    def write(self, stamps: np.ndarray[Any, Any], values: np.ndarray[Any, Any]) -> None:
        for t_ns, row in zip(stamps.tolist(), values, strict=True):
            if t_ns < self._next_ns:
                continue
            self._next_ns = t_ns - t_ns % self._period_ns + self._period_ns if (
                self._period_ns) else 0
            self._encoder.values[:] = row
            self._out.write_raw(
                "/odometry", OUTPUTS["odometry"], self._encoder.message(t_ns), t_ns)


def _say(level: str, text: str) -> None:
    tqdm.write(f"ins_replay: {level}: {text}", file=sys.stderr)


def read_values(file: str | None, overrides: Sequence[str]) -> parameters.Values:
    """
    Return checked parameters of a file and ``name:=value`` overrides.

    Raises
    ------
    InputError
        See `parameters.load_file`; or an override has not that form.
    """
    values: dict[str, Any] = dict(parameters.load_file(file)) if file else {}
    for text in overrides:
        name, separator, value = text.partition(":=")
        if not separator:
            raise InputError(f"--param {text}: write NAME:=VALUE, e.g. -p gnss.patience:=5.0")
        values[name] = parameters.parse_value(name, value)
    return parameters.check_all(values)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program."""
    parser = program.parser(
        "ins_replay",
        "Estimate a recorded run: IMU and GNSS from a bag (rosbag2 MCAP or SQLite, ROS 1) through\n"
        "the node's own estimator, without middleware, faster than real time and repeatably.\n"
        "The output bag holds the node's topics, the fixes and any truth: ready for ins_evaluate.",
        "ins_replay flight.mcap estimate.mcap --params-file params.yaml")
    parser.add_argument("input", metavar="IN", help="bag with sensor_msgs/Imu and NavSatFix")
    parser.add_argument("output", metavar="OUT", help="bag to write (directory, or *.mcap file)")
    parser.add_argument("--params-file", metavar="F",
                        help="parameter file, the same as the node's (default: the defaults)")
    parser.add_argument("-p", "--param", metavar="NAME:=VALUE", action="append", default=[],
                        help="set one parameter; goes before the file; may be repeated")
    parser.add_argument("--imu-topic", default="/imu/data", metavar="T", help="%(default)s")
    parser.add_argument("--fix-topic", default="/gnss/fix", metavar="T", help="%(default)s")
    parser.add_argument("--velocity-topic", default="/gnss/velocity", metavar="T",
                        help="%(default)s, used where the bag has it")
    parser.add_argument("--overwrite", action="store_true", help="replace OUT")
    return program.run(_body, parser.parse_args(argv))


def _body(args: argparse.Namespace) -> int:
    values = read_values(args.params_file, args.param)
    with BagReader(Path(args.input)) as bag:
        with BagWriter(Path(args.output), overwrite=args.overwrite) as out:
            estimator = replay(
                bag, out, values, imu_topic=args.imu_topic, fix_topic=args.fix_topic,
                velocity_topic=args.velocity_topic)
    if not estimator.ever_aligned:
        raise InputError(f"{args.input}: the filter never started: it waited for "
                         f"{estimator.navigator.waiting_for}; {args.output} holds no odometry")
    print(estimator.summary())
    return 0
