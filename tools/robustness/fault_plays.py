"""Faults injected into a flight that is played into the live node over DDS."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import replace
from pathlib import Path
from queue import SimpleQueue

from hybrid_ins import parameters
from hybrid_ins.parameters import parameter_file
from tools.processes import Processes, isolated_ros, program
from tools.robustness.campaign_results import LIVE, Row
from tools.robustness.fault_output import Trace, examine
from tools.robustness.fault_replays import Case, inject, judge
from tools.robustness.faults import Fault


def run_live(plays: Sequence[tuple[Case, Fault, Trace, float]], jobs: int) -> Iterator[Row]:
    """
    Yield the results of live runs as they come, some at a time, on ROS domains of their own.

    Parameters
    ----------
    plays : sequence of tuple
        Flight, fault, error of the undisturbed flight, multiple of real time.
    jobs : int
        At a time.
    """
    domains: SimpleQueue[dict[str, str]] = SimpleQueue()
    for _ in range(jobs):
        domains.put(isolated_ros())
    with ThreadPoolExecutor(jobs) as pool:
        futures = [pool.submit(_attempt, *play, domains) for play in plays]
        try:
            for future in as_completed(futures):
                yield future.result()
        finally:
            pool.shutdown(cancel_futures=True)


def _attempt(
    case: Case, fault: Fault, clean: Trace, rate: float, domains: SimpleQueue[dict[str, str]]
) -> Row:
    """Play one fault into the node over DDS, at a multiple of real time, on a free domain."""
    domain = domains.get()
    try:
        with tempfile.TemporaryDirectory() as folder:
            return _play(case, fault, clean, rate, Path(folder), domain)
    finally:
        domains.put(domain)


def _play(
    case: Case, fault: Fault, clean: Trace, rate: float, folder: Path, domain: dict[str, str]
) -> Row:
    bag, estimate = folder / "disturbed.mcap", folder / "estimate.mcap"
    log, values_file = folder / "node.log", folder / "values.yaml"
    inject(case, fault, bag)
    values = parameters.check_all({**case.values, **fault.values})
    values_file.write_text(parameter_file.to_yaml(values, "Of the fault campaign."))
    with Processes() as processes, log.open("w") as output:
        node = processes.start(
            [program("ins_node"), "--ros-args", "--params-file", values_file], output, domain
        )
        player = processes.start(
            [
                program("ins_play"),
                bag,
                "--rate",
                str(rate),
                "--record",
                estimate,
                "--wait",
                "120",
                "--overwrite",
            ],
            output,
            domain,
        )
        player.wait(600.0)
        ended_early = node.poll() is not None
        status = processes.stop(node)
    words = log.read_text(errors="replace")
    row = judge(
        fault,
        case,
        examine(
            estimate,
            bag,
            case.origin_ns,
            float(str(values["gnss.time_offset.value"])),
            fault.stamp_shift,
        ),
        clean,
    )
    failures = [*row.failures]
    if player.returncode or status or ended_early:
        failures.append(f"exit status: player {player.returncode}, node {status}")
    if "Traceback" in words:
        failures.append("traceback: " + words.strip().splitlines()[-1])
    return replace(row, case=case.name + LIVE, failures=tuple(failures))
