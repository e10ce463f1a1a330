"""
The filter by itself: this one and its peers fly the same simulated flight, side by side.

Every contender takes the same IMU samples and fixes from the same wrong start, and is scored
against the truth midway between fixes, so that speed stands beside accuracy.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from hybrid_ins.core.inertial.earth import curvature_scale, lla_to_ecef
from tools.benchmark.calls import measure_calls
from tools.benchmark.contenders import (
    FIX_RATE,
    RATE,
    Careful,
    Compiled,
    Contender,
    Filterpy,
    Gtsam,
)
from tools.benchmark.table import Section, ratios
from tools.paper.runs import Run, Scenario, draw


def _clocks() -> float:
    """CPU time [s] that reading both clocks takes: as much as a short block."""
    spent = []
    for _ in range(1000):
        start = time.process_time()
        time.perf_counter()
        time.perf_counter()
        spent.append(time.process_time() - start)
    return float(np.median(spent))


CLOCKS = _clocks()


class Flights:
    """What a contender's flights gave: seconds per sample and per fix, wall and CPU, and errors."""

    def __init__(self, name: str, make: Callable[[Run], Contender], arrays: bool = False) -> None:
        self.name = name
        self.make = make
        self.arrays = arrays  # takes a block's samples as arrays
        self.step: list[float] = []
        self.step_cpu: list[float] = []
        self.update: list[float] = []
        self.rmse = self.nees = float("nan")

    def fly(self, run: Run, blocks: list[tuple[Any, Any, Any, Any]]) -> None:
        """Fly once; the errors are those of the last flight."""
        contender = self.make(run)
        stepping = stepping_cpu = updating = 0.0
        errors, nees = [], []
        samples = 0
        for (dt, values, dt_list, values_list), (kind, k) in zip(blocks, _order(run), strict=True):
            given = (dt, values) if self.arrays else (dt_list, values_list)
            cpu, wall = time.process_time(), time.perf_counter()
            contender.block(*given)
            stepping += time.perf_counter() - wall
            stepping_cpu += time.process_time() - cpu - CLOCKS
            samples += len(dt)
            if kind == "fix":
                wall = time.perf_counter()
                contender.fix(run.fixes[k])
                updating += time.perf_counter() - wall
            else:
                position = lla_to_ecef(contender.lla()) - lla_to_ecef(run.lla[k])
                errors.append(np.linalg.norm(position))
                P = contender.P()
                if P is not None:
                    away = (run.lla[k] - contender.lla()) * curvature_scale(run.lla[k])
                    nees.append(away @ np.linalg.solve(P[:3, :3], away))
        self.step.append(stepping / samples * 1e6)
        self.step_cpu.append(stepping_cpu / samples * 1e6)
        self.update.append(updating / len(run.fixes) * 1e6)
        self.rmse = float(np.sqrt(np.mean(np.square(errors))))
        self.nees = float(np.mean(nees)) if nees else float("nan")


def _order(run: Run) -> Iterator[tuple[str, int]]:
    """What comes after each block of samples: a fix or a look at the errors, in time order."""
    stamps = run.samples["t_ns"]
    events = [(fix.t_ns, 0, "fix", k) for k, fix in enumerate(run.fixes)]
    events += [(int(stamps[row]), 1, "score", k) for k, row in enumerate(run.scored)]
    return ((kind, k) for *_, kind, k in sorted(events))


def _blocks(run: Run) -> list[tuple[Any, Any, Any, Any]]:
    """Cut the samples at the fixes and looks, as arrays and as lists."""
    stamps = run.samples["t_ns"]
    readings = np.hstack((run.samples["f"], run.samples["w"]))
    dt = np.diff(stamps, prepend=stamps[0]) * 1e-9
    ends = sorted([fix.t_ns for fix in run.fixes] + stamps[run.scored].tolist())
    blocks, at = [], 1
    for end in ends:
        stop = int(np.searchsorted(stamps, end, side="right"))
        part = slice(at, stop)
        blocks.append((dt[part], readings[part], dt[part].tolist(), readings[part].tolist()))
        at = stop
    return blocks


def _available() -> tuple[list[Flights], list[str]]:
    """Return the contenders whose packages are there, and what is said of the others."""
    found = [
        Flights("live step", lambda run: Compiled(run, False, 0.0)),
        Flights("live step, covariance every 10 ms", lambda run: Compiled(run, False, 0.01 - 1e-6)),
        Flights("batch step", lambda run: Compiled(run, True, 0.0), arrays=True),
        Flights(
            "batch step, covariance every 10 ms",
            lambda run: Compiled(run, True, 0.01 - 1e-6),
            arrays=True,
        ),
        Flights("careful NumPy", Careful),
    ]
    missing = []
    peers = (("filterpy", Filterpy, "filterpy.kalman"), ("GTSAM", Gtsam, "gtsam"))
    for name, kind, module in peers:
        try:
            __import__(module)
        except ImportError as error:
            missing.append(f"{name} is left out: {error}; pip install -e '.[benchmark]' brings it.")
        else:
            found.append(Flights(name, kind, arrays=name == "GTSAM"))
    return found, missing


def measure(quick: bool) -> Section:
    """Fly all contenders in turn, again and again; then the calls around the filter."""
    section = Section("Filter kernel")
    run = draw(
        Scenario(
            "benchmark",
            rate=RATE,
            fix_rate=FIX_RATE,
            scored_from=5.0,
            duration=12.0 if quick else 60.0,
        ),
        seed=1,
    )
    blocks = _blocks(run)
    contenders, missing = _available()
    for contender in contenders:  # compiles, and fills caches
        contender.make(run).block(*blocks[0][:2] if contender.arrays else blocks[0][2:])
    for repetition in range(2 if quick else 15):
        # Nobody is always first.
        shift = repetition % len(contenders)
        for contender in contenders[shift:] + contenders[:shift]:
            contender.fly(run, blocks)
    careful = next(c for c in contenders if c.name == "careful NumPy")
    bars = {"live step": (32.0, None), "batch step": (60.0, None)}
    for c in contenders:
        section.add(c.name, "µs", c.step)
        section.add(f"{c.name}, CPU", "µs", c.step_cpu)
    for c in contenders:
        if c is not careful:
            bar, stretch = bars.get(c.name, (None, None))
            section.add(
                f"careful NumPy / {c.name}",
                "×",
                ratios(careful.step, c.step),
                bar,
                stretch,
                higher=True,
            )
        if c.name in bars:
            section.add(
                f"careful NumPy / {c.name}, CPU",
                "×",
                ratios(careful.step_cpu, c.step_cpu),
                *bars[c.name],
                higher=True,
            )
    rows = [["", "step [µs]", "fix [µs]", "position RMSE [m]", "position NEES (3)"]]
    rows += [
        [
            c.name,
            f"{np.median(c.step):.3g}",
            f"{np.median(c.update):.3g}",
            f"{c.rmse:.4f}",
            f"{c.nees:.2f}" if np.isfinite(c.nees) else "-",
        ]
        for c in contenders
    ]
    section.tables.append(
        (
            f"The same {run.samples['t_ns'].size / RATE:.0f} s flight, {RATE:.0f} Hz IMU, "
            f"{FIX_RATE:.0f} Hz fixes, scored midway between fixes",
            rows,
        )
    )
    section.remarks += missing
    section.remarks += [
        "A step is mechanisation, F, Q and covariance of 15 states, called from Python; a batch "
        "takes the samples between two fixes (20 here) in one call.",
        "filterpy has no navigation: its Kalman filter runs inside the careful mechanisation. "
        "GTSAM preintegrates (combined IMU factor, flat Earth without its rotation) and solves "
        "with ISAM2 at every fix.",
    ]
    measure_calls(section, run, quick)
    return section
