"""
``ins_node`` between a process that sends and one that takes, beside a node that does nothing.

CPU time is the kernel's account of the node's process, so that a busy machine distorts it little.
Latency runs from the IMU message's stamp, taken right before it is sent, to the time at which the
middleware was given the odometry of that stamp.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tools.benchmark.table import Section, number, ratios
from tools.processes import Processes, claim_ros_domain

NAIVE = [sys.executable, "-m", "tools.benchmark.naive_node"]
OURS = [
    sys.executable,
    "-m",
    "hybrid_ins.ros.node",
    "--ros-args",
    "-p",
    "alignment.heading_source:=imu",
]
LOAD = [sys.executable, "-m", "tools.benchmark.imu_load"]
TICKS = os.sysconf("SC_CLK_TCK")
SETTLING = 3.5  # s, until the filter runs

ANNOUNCING = """<?xml version="1.0" encoding="UTF-8"?>
<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"><profiles>
<participant profile_name="announcing" is_default_profile="true"><rtps><builtin><discovery_config>
<leaseAnnouncement><sec>0</sec><nanosec>200000000</nanosec></leaseAnnouncement>
</discovery_config></builtin></rtps></participant>
</profiles></dds>
"""


@dataclass
class Passage:
    """What one stream through a node gave."""

    cpu: float  # seconds per second
    per_message: float  # s, of CPU time for each answer
    sent: int  # in the time that counts
    answered: int
    latency_ms: NDArray[np.float64]


@dataclass
class Node:
    """A node that runs, and what was measured of it so far."""

    name: str
    process: subprocess.Popen[str]
    environment: dict[str, str]
    lines: list[str] = field(default_factory=list)

    def cpu_seconds(self) -> float:
        """CPU time of the process so far, all its threads."""
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / TICKS

    def memory_mb(self) -> float:
        """Resident memory now."""
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        return int(status.partition("VmRSS:")[2].split()[0]) / 1024.0

    def wait_for(self, text: str, patience: float) -> float:
        """Wait until the node has said something; return how long that took [s]."""
        start = time.monotonic()
        while not any(text in line for line in self.lines):
            if self.process.poll() is not None or time.monotonic() - start > patience:
                raise RuntimeError(f"{self.name} did not say '{text}':\n" + "".join(self.lines))
            time.sleep(0.005)
        return time.monotonic() - start


def start(
    processes: Processes, name: str, command: Sequence[str | Path], environment: dict[str, str]
) -> Node:
    """Start a process and collect its lines."""
    process = processes.start(
        command,
        subprocess.PIPE,
        {"PYTHONUNBUFFERED": "1", "PYTHONPATH": os.pathsep.join(sys.path), **environment},
    )
    node = Node(name, process, environment)

    def listen() -> None:
        assert process.stdout is not None
        for line in process.stdout:
            node.lines.append(line)

    threading.Thread(target=listen, daemon=True).start()
    return node


def domain() -> dict[str, str]:
    """Return the environment of a ROS domain of its own."""
    return {"ROS_DOMAIN_ID": str(claim_ros_domain()), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}


@dataclass(frozen=True)
class Load:
    """What a node is given."""

    rate: float  # Hz, of the Imu messages
    aiding: bool = False  # wheels and a barometer besides

    def __str__(self) -> str:
        return f"{self.rate:.0f} Hz" + " with two aiding sources" * self.aiding


def drive(
    processes: Processes, node: Node, load: Load, duration: float, folder: Path, times: bool
) -> Passage:
    """Send a stream through a node; the time after the filter has started counts."""
    sent_file, taken_file = folder / "sent.npy", folder / "taken.npy"
    taker = start(
        processes,
        "imu_load.py",
        [*LOAD, "take", taken_file, *(["--times"] if times else [])],
        node.environment,
    )
    taker.wait_for("ready", 30.0)
    sender = start(
        processes,
        "imu_load.py",
        [
            *(*LOAD, "send", str(load.rate), str(SETTLING + duration + 1.0), sent_file),
            *(["--aiding"] if load.aiding else []),
        ],
        node.environment,
    )
    idle = node.cpu_seconds()
    end = time.monotonic() + 30.0
    while node.cpu_seconds() - idle < 0.03 and time.monotonic() < end:
        time.sleep(0.01)  # it has not come yet
    time.sleep(SETTLING)
    began_ns, before = time.time_ns(), node.cpu_seconds()
    time.sleep(duration)
    ended_ns, after = time.time_ns(), node.cpu_seconds()
    if sender.process.wait(60.0) != 0:
        raise RuntimeError("imu_load.py: " + "".join(sender.lines))
    processes.stop(sender.process)
    if processes.stop(taker.process) != 0:
        raise RuntimeError("imu_load.py: " + "".join(taker.lines))
    sent, (stamps, published) = np.load(sent_file), np.load(taken_file)
    counted = (sent >= began_ns) & (sent < ended_ns)
    there = (stamps >= began_ns) & (stamps < ended_ns)
    latency = (published[there] - stamps[there]) * 1e-6 if times else np.empty(0)
    # Answers that were given in that time: a node that falls behind answers later.
    when = published if times else stamps
    answers = int(np.sum((when >= began_ns) & (when < ended_ns)))
    return Passage(
        (after - before) / ((ended_ns - began_ns) * 1e-9),
        (after - before) / max(answers, 1),
        int(counted.sum()),
        len(np.unique(stamps[there])),
        latency,
    )


@contextmanager
def nodes(processes: Processes) -> Iterator[tuple[Node, Node]]:
    """Run both nodes, each in a domain of its own."""
    ours = start(processes, "ins_node", OURS, domain())
    naive = start(processes, "naive_node.py", NAIVE, domain())
    ours.wait_for("ready", 300.0)
    naive.wait_for("ready", 30.0)
    yield ours, naive
    processes.stop(ours.process)
    processes.stop(naive.process)


def measure(quick: bool) -> Section:
    """CPU and latency at several rates, both nodes in turn; memory at the end."""
    section = Section("Node over DDS")
    loads = [Load(100.0), Load(100.0, True)]
    if not quick:
        loads = [*map(Load, (100.0, 200.0, 400.0, 1000.0)), Load(400.0, True)]
    duration, repetitions = (1.5, 1) if quick else (6.0, 3)
    cpu: dict[tuple[str, Load], list[float]] = {}
    per_message: dict[tuple[str, Load], list[float]] = {}
    latency: dict[tuple[str, Load], list[tuple[float, float]]] = {}
    lost: dict[Load, int] = dict.fromkeys(loads, 0)
    with (
        Processes() as processes,
        tempfile.TemporaryDirectory() as folder,
        nodes(processes) as both,
    ):
        for repetition in range(repetitions):
            for load in loads:
                for node in both if repetition % 2 == 0 else both[::-1]:
                    passage = drive(processes, node, load, duration, Path(folder), True)
                    if passage.answered == 0:
                        raise RuntimeError(
                            f"{node.name} published nothing:\n" + "".join(node.lines[-20:])
                        )
                    key = node.name, load
                    cpu.setdefault(key, []).append(100.0 * passage.cpu)
                    per_message.setdefault(key, []).append(passage.per_message)
                    p50, p99 = np.quantile(passage.latency_ms, [0.5, 0.99])
                    latency.setdefault(key, []).append((float(p50), float(p99)))
                    if node is both[0]:
                        lost[load] += passage.sent - passage.answered
        memory = [node.memory_mb() for node in both]
    ours, naive = "ins_node", "naive_node.py"
    strict = (Load(1000.0), Load(400.0, True))  # what is to be as fast as it can be
    bars = {**dict.fromkeys(strict, (0.35, None)), Load(200.0): (0.6, 0.5)}
    for load in loads:
        bar, stretch = bars.get(load, (None, None))
        section.add(
            f"CPU ratio at {load}",
            "×",
            ratios(per_message[ours, load], per_message[naive, load]),
            bar,
            stretch,
        )
    for load in loads:
        section.add(
            f"CPU at {load}",
            "%",
            cpu[ours, load],
            note=f"naive {number(float(np.median(cpu[naive, load])))} %",
        )
    for load in loads:
        for k, (name, bar, stretch) in enumerate((("p50", 0.25, 0.15), ("p99", 0.25, None))):
            naive_median = float(np.median([v[k] for v in latency[naive, load]]))
            section.add(
                f"latency {name} at {load}",
                "ms",
                [v[k] for v in latency[ours, load]],
                *((bar, stretch) if load in strict else ()),
                note=f"naive {number(naive_median)} ms",
            )
    section.add("memory", "MB", [memory[0]], 200.0, None, note=f"naive {memory[1]:.0f} MB")
    section.remarks += [
        "In: Imu at the rate, NavSatFix at 5 Hz. Out: odometry at the IMU's rate and all else, "
        "learned noise; a subscriber takes the odometry. Aiding sources: velocity and pressure at "
        "50 Hz each, to which only ins_node subscribes. The naive node "
        "(tools/benchmark/naive_node.py) publishes empty Odometry messages.",
        "CPU: of the process, in percent of a core; the ratio is that of the CPU times for a "
        "message answered, since a node that is starved answers less. Latency: stamp to "
        "publication.",
        "The vehicle hovers, so that motion never confirms the given heading nor the clock "
        "offset: the filters that check them run all the time.",
        f"IMU messages without odometry: {sum(lost.values())}.",
    ]
    return section


def measure_rate(quick: bool) -> Section:
    """Find the rates that pass without loss."""
    section = Section("Highest rate")
    duration, rates = (2.0, [1000.0]) if quick else (60.0, [4000.0, 8000.0])
    with Processes() as processes, tempfile.TemporaryDirectory() as folder:
        node = start(processes, "ins_node", OURS, domain())
        node.wait_for("ready", 300.0)
        highest = 0.0
        for rate in rates:
            passage = drive(processes, node, Load(rate), duration, Path(folder), False)
            lost, reached = passage.sent - passage.answered, passage.sent / duration
            if lost == 0:
                highest = max(highest, reached)
            section.remarks.append(
                f"{rate:.0f} Hz asked for, {reached:.0f} Hz sent: {lost} of {passage.sent} lost, "
                f"CPU of the node {100.0 * passage.cpu:.0f} %."
            )
    section.add("IMU rate without loss", "Hz", [highest], 3990.0, 7900.0, higher=True)
    section.remarks.append(
        f"For {duration:.0f} s, with odometry at every sample: a message counts as lost when no "
        "odometry of its stamp reached the other process. Sender, node and taker share the "
        "processors."
    )
    return section


def measure_start(quick: bool) -> Section:
    """Measure the start: from an empty kernel cache, and from a full one."""
    section = Section("Start")
    ready, first, cold = [], [], []
    alone: dict[str, list[float]] = {"ins_node": [], "naive": []}
    with Processes() as processes, tempfile.TemporaryDirectory() as folder:
        profile = Path(folder) / "announcing.xml"
        profile.write_text(ANNOUNCING)
        announcing = {"FASTRTPS_DEFAULT_PROFILES_FILE": str(profile)}
        for _ in range(1 if quick else 7):
            after = _start_between(processes, Path(folder), "ins_node", OURS, announcing)
            ready.append(after[0])
            first.append(after[1])
        for _ in range(1 if quick else 3):
            for name, command in (("ins_node", OURS), ("naive", NAIVE)):
                alone[name].append(_start_between(processes, Path(folder), name, command, {})[1])
        for _ in range(0 if quick else 2):
            with tempfile.TemporaryDirectory() as cache:
                node = start(processes, "ins_node", OURS, {**domain(), "NUMBA_CACHE_DIR": cache})
                cold.append(node.wait_for("ready", 300.0))
                processes.stop(node.process)
    section.add(
        "cached start to first odometry",
        "s",
        first,
        2.5,
        1.5,
        note="default parameters, heading given; 1 s of it is levelling",
    )
    section.add("cached start to ready", "s", ready, 3.0)
    for name, seconds in alone.items():
        section.add(f"{name} to first odometry, peers announced every 3 s", "s", seconds)
    if cold:
        section.add("cold start to ready", "s", cold, note="everything is compiled")
    section.remarks.append(
        "From the launch of the process to the first odometry that another process received; that "
        "one and the IMU's ran before. A process that is new to Fast DDS and one that is there "
        "find each other either at once or when the older one announces itself next, every 3 s: "
        "that lottery is left out by peers that announce themselves every 0.2 s. With the "
        "middleware's defaults it hits an empty node alike, as the last lines show."
    )
    return section


def _start_between(
    processes: Processes,
    folder: Path,
    name: str,
    command: Sequence[str | Path],
    peers: dict[str, str],
) -> tuple[float, float]:
    """Start a node between a sender and a taker; return when it was ready, and first heard [s]."""
    environment, taken = domain(), folder / "taken.npy"
    taker = start(
        processes, "imu_load.py", [*LOAD, "take", taken, "--times"], {**environment, **peers}
    )
    taker.wait_for("ready", 30.0)
    sender = start(
        processes,
        "imu_load.py",
        [*LOAD, "send", "200", "8", folder / "sent.npy"],
        {**environment, **peers},
    )
    # The stream is there before the node: it waits for a listener to discover.
    time.sleep(1.0)
    began_ns = time.time_ns()
    node = start(processes, name, command, environment)
    ready = node.wait_for("ready", 300.0)
    sender.process.wait(60.0)
    for other in (sender, taker, node):
        processes.stop(other.process)
    _, published = np.load(taken)
    if len(published) == 0:
        raise RuntimeError(f"{name} published nothing:\n" + "".join(node.lines))
    return ready, (published[0] - began_ns) * 1e-9
