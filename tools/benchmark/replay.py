"""``ins_replay`` and ``ins_calibrate``: whole processes, and where a replay's time goes."""

from __future__ import annotations

import cProfile
import os
import pstats
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from hybrid_ins import parameters
from hybrid_ins.bags.reader import BagReader
from hybrid_ins.bags.writer import BagWriter
from hybrid_ins.cli import simulate
from hybrid_ins.replay import replay
from tools.benchmark.table import Section

REPLAY = "hybrid_ins.cli.replay"
CALIBRATE = "hybrid_ins.cli.calibrate"
PARTS = (  # what a function belongs to, by the beginning of its module's path in the package
    ("bags/", "bags"),
    ("replay", "replay"),
    ("noise_regressor/", "regressor"),
    ("ros/review/", "input checks"),
    ("ros/", "conversions and reports"),
    ("core/imu/", "input checks"),
    ("core/imu_axes/", "input checks"),
    ("core/constraints/", "input checks"),
    ("core/noise/multiple_model", "noise factors"),
    ("core/alignment/", "searches"),
    ("core/", "filter"),
)


def measure(quick: bool) -> Section:
    """Replay ten simulated minutes at 200 Hz again and again, then once under the profiler."""
    section = Section("Replay")
    duration = 20.0 if quick else 600.0
    with tempfile.TemporaryDirectory() as folder:
        bag = _drive(Path(folder), duration)
        faster, faster_cpu, inside = [], [], []
        for repetition in range(1 if quick else 5):
            out = Path(folder) / f"estimate_{repetition}.mcap"
            seconds, cpu = _run(REPLAY, bag, out)
            faster.append(duration / seconds)
            faster_cpu.append(duration / cpu)
            out.unlink()
        out = Path(folder) / "inside.mcap"
        for _ in range(1 if quick else 5):
            start = time.perf_counter()
            _replay(bag, out)
            inside.append(duration / (time.perf_counter() - start))
        profiler = cProfile.Profile()
        profiler.runcall(_replay, bag, out)
    section.add(
        "ins_replay, bag to bag",
        "× real time",
        faster,
        250.0,
        400.0,
        higher=True,
        note="the whole process, its start included",
    )
    section.add("ins_replay, by its CPU time", "× real time", faster_cpu, higher=True)
    section.add("without the process's start", "× real time", inside, higher=True)
    section.tables.append(
        ("Where the time goes (share of the run, under a profiler)", _profile(profiler))
    )
    section.remarks.append(
        f"{duration / 60.0:.3g} minutes of a simulated drive with 200 Hz IMU, 5 Hz fixes and "
        "100 Hz truth, default parameters; both odometries are written at the IMU's rate."
    )
    return section


def measure_calibration(quick: bool) -> Section:
    """Calibrate by ten simulated minutes at 200 Hz, again and again."""
    section = Section("Calibration")
    duration = 20.0 if quick else 600.0
    wall, cpu = [], []
    with tempfile.TemporaryDirectory() as folder:
        bag = _drive(Path(folder), duration)
        for _ in range(1 if quick else 3):
            seconds, spent = _run(CALIBRATE, bag)
            wall.append(seconds)
            cpu.append(spent)
    section.add("ins_calibrate", "s", wall, None if quick else 20.0, note="the whole process")
    section.add("ins_calibrate, CPU time of all its threads", "s", cpu)
    section.remarks.append(
        f"{duration / 60.0:.3g} minutes of a simulated drive with 200 Hz IMU and 5 Hz fixes."
    )
    return section


def _drive(folder: Path, duration: float) -> Path:
    """Simulate a drive; return its bag."""
    bag = folder / "drive.mcap"
    status = simulate.main(
        [str(bag), "--trajectory", "car", "--duration", str(duration), "--imu-rate", "200"]
    )
    if status != 0:
        raise RuntimeError("ins_simulate failed")
    return bag


def _run(program: str, *arguments: Path) -> tuple[float, float]:
    """Run a program; return its time and its CPU time [s]."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    start = time.perf_counter()
    subprocess.run(
        [sys.executable, "-c", f"import sys; from {program} import main; sys.exit(main())"]
        + [str(argument) for argument in arguments],
        check=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )
    seconds = time.perf_counter() - start
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return seconds, after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime


def _replay(source: Path, target: Path) -> None:
    with BagReader(source) as bag, BagWriter(target, overwrite=True) as out:
        replay(bag, out, parameters.check_all({}), log=lambda level, text: None)


def _profile(profiler: cProfile.Profile) -> list[list[str]]:
    """Return the shares of the parts; what a foreign function takes goes to its callers."""
    stats = pstats.Stats(profiler).stats  # type: ignore[attr-defined]
    shares: dict[str, float] = {}
    for (file, _, _), (_, _, own, _, callers) in stats.items():
        part = _part(file)
        if part is not None:
            shares[part] = shares.get(part, 0.0) + own
            continue
        for (caller_file, _, _), (_, _, own_from_caller, _) in callers.items():
            part = _part(caller_file) or "other"
            shares[part] = shares.get(part, 0.0) + own_from_caller
    total = sum(shares.values())
    return [
        ["part", "share"],
        *(
            [part, f"{100.0 * share / total:.0f} %"]
            for part, share in sorted(shares.items(), key=lambda item: -item[1])
        ),
    ]


def _part(file: str) -> str | None:
    """Return what a function of a file belongs to; None outside of the package."""
    inside = file.rpartition("/hybrid_ins/")[2]
    return next((part for start, part in PARTS if inside.startswith(start)), None)
