"""A recording published over DDS, and its echo recorded: what ``ins_play`` does."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

from hybrid_ins.bags.messages import LATCHED, TRUTH, absolute, is_standard
from hybrid_ins.bags.reader import BagReader
from hybrid_ins.bags.writer import BagWriter
from hybrid_ins.errors import InputError
from hybrid_ins.ros.messages.interface import PUBLISHED

ESTIMATES = tuple(absolute(topic.name) for topic in PUBLISHED if topic.name != "/tf")
NOT_PLAYED = (*ESTIMATES, "/clock", "/tf", "/rosout", "/parameter_events")

_CLOCK_END_NS = 2**31 * 10**9  # the seconds of a stamp have 32 bits: January 2038
_SETTLING = 0.3  # s; a subscriber learns of us a little later than we learn of it

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Selection:
    """What is played of a bag, and how."""

    topics: Sequence[str] | None = None  # None: all but NOT_PLAYED and the truth
    start: float = 0.0  # s after the first message
    duration: float = math.inf  # s
    rate: float = 1.0  # bag seconds per second
    remap: Mapping[str, str] = field(default_factory=dict)  # topic of ROS by topic of a bag
    clock: bool = True  # publish /clock
    patience: float = 10.0  # s, to wait for subscribers and publishers
    drain: float = 1.0  # s, to go on after the last message


@dataclass(frozen=True)
class Recording:
    """Where and what is recorded."""

    path: Path
    topics: Sequence[str] = ESTIMATES
    overwrite: bool = False


def play(
    source: Path,
    selection: Selection,
    recording: Recording | None = None,
    ros_args: Sequence[str] = (),
    report: Callable[[str], None] = print,
) -> None:
    """
    Publish a bag, and record what is published in return.

    Parameters
    ----------
    source : Path
        A bag.
    selection : Selection
    recording : Recording, optional
    ros_args : sequence of str
        From ``--ros-args`` on.
    report : callable
        Called with a text on what was played, and one on what was recorded.

    Raises
    ------
    InputError
        ROS 2 is not installed, a topic does not exist or a name is invalid, the bag cannot be read
        or written, or nothing came back.

    """
    try:
        from hybrid_ins.ros.player import Player, Timeline, started_node
        from hybrid_ins.ros.recorder import Recorder
    except ImportError as error:
        raise InputError(
            f"ROS 2 is not installed ({error}): source its setup file, or install hybrid_ins[ros]"
        ) from None

    with ExitStack() as stack:
        bag = stack.enter_context(BagReader(source))
        out = None
        if recording is not None:
            writer = BagWriter(recording.path, recording.overwrite, inputs=[source])
            out = stack.enter_context(writer)
        topics = _topics_to_play(bag, selection.topics)
        first_ns = bag.start_ns + round(selection.start * 1e9)
        last_ns = bag.end_ns
        if selection.duration < math.inf:
            last_ns = min(last_ns, first_ns + round(selection.duration * 1e9))
        if first_ns > bag.end_ns:
            seconds = (bag.end_ns - bag.start_ns) / 1e9
            raise InputError(f"--start {selection.start:g}: {source} is only {seconds:.1f} s long")
        if selection.clock and last_ns >= _CLOCK_END_NS:
            raise InputError(
                f"{source}: its times are beyond January 2038, where those of /clock end: "
                "play it with --no-clock, or --duration"
            )
        recorded = () if recording is None else map(absolute, recording.topics)
        unknown = sorted(set(selection.remap) - {*bag.topics, *recorded})
        if unknown:
            _log.warning("--remap %s: neither played nor recorded", ", ".join(unknown))

        node = stack.enter_context(started_node(ros_args))
        timeline = Timeline(first_ns, selection.rate)
        player = Player(node, topics, selection.remap, latched=LATCHED, clock=selection.clock)
        recorder = None
        if out is not None and recording is not None:
            recorder = Recorder(node, out.write_raw, is_standard, timeline, out.flush)
            stack.enter_context(recorder)
            names = [absolute(topic) for topic in recording.topics]
            recorder.subscribe(names, selection.remap, selection.patience)
        player.wait_for_subscribers(selection.patience)
        time.sleep(_SETTLING)

        def check() -> None:
            if recorder is not None:
                recorder.check()

        # What is latched, such as /tf_static, holds although it was published before the start.
        messages = (
            (topic, max(log_ns, first_ns), data)
            for topic, log_ns, data in bag.raw(*topics)
            if log_ns <= last_ns and (log_ns >= first_ns or topic in LATCHED)
        )
        player.play(messages, timeline, last_ns, check)
        player.drain(timeline, selection.drain, check)
        report(player.report(selection.rate))
        if recorder is not None and recording is not None:
            report(recorder.report(str(recording.path)))


def _topics_to_play(bag: BagReader, named: Sequence[str] | None) -> dict[str, str]:
    if named is None:
        topics = {
            topic: type_name
            for topic, type_name in bag.topics.items()
            if topic not in NOT_PLAYED and not topic.startswith(TRUTH)
        }
    else:
        names = [absolute(name) for name in named]
        unknown = [name for name in names if name not in bag.topics]
        if unknown:
            raise InputError(
                f"--topics {unknown[0]}: {bag.path} has {', '.join(sorted(bag.topics))}"
            )
        topics = {name: bag.topics[name] for name in names}
    if not topics:
        raise InputError(
            f"{bag.path}: has only {', '.join(sorted(bag.topics))}: name what to play with --topics"
        )
    return topics
