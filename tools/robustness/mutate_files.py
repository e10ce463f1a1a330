"""
Broken files through every program that reads them: bags, parameter files, models, flights.

Each mutation is drawn from a seed. Each run is a process of its own, and must end within a minute
by itself: with a clear line and a status that is not zero, or with a result of numbers.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import shutil
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from hybrid_ins import parameters, progress
from hybrid_ins.bags.messages import new_message
from hybrid_ins.bags.reader import BagReader
from hybrid_ins.bags.writer import BagWriter
from hybrid_ins.cli import calibrate, convert, evaluate, options, program, replay, simulate
from hybrid_ins.parameters import parameter_file
from hybrid_ins.resources import share_path
from tools.processes import isolated_ros
from tools.robustness.mutations import BYTES, Draw, made_up_yaml, odd_words, shuffle_lines

PATIENCE = 60.0  # s
NODE_RUNS = 5.0  # s until it is asked to stop


@dataclass(frozen=True)
class Outcome:
    """How a run ended."""

    program: str
    name: str
    status: int  # negative: the signal that ended it
    words: str  # what it printed
    trouble: str  # empty: as it should be


# Mutations of bytes.


# Mutations of parameter files.


# Runs.


@dataclass(frozen=True)
class Files:
    """Sound files to start from."""

    folder: Path
    bag: Path
    estimate: Path
    yaml: Path
    models: tuple[Path, ...]
    flight: Path | None


def make_files(folder: Path, flight: Path | None) -> Files:
    """Make small ones of each kind."""
    bag, estimate, yaml = folder / "bag.mcap", folder / "estimate.mcap", folder / "sound.yaml"
    quiet = ["--overwrite"]
    simulate.main(
        [
            str(bag),
            "--imu-rate",
            "50",
            "--duration",
            "14",
            "--truth-rate",
            "10",
            "--gnss-velocity",
            *quiet,
        ]
    )
    replay.main([str(bag), str(estimate), "-p", "alignment.heading_source:=parameter", *quiet])
    yaml.write_text(parameter_file.to_yaml(parameters.defaults(), "All parameters."))
    models = tuple(share_path(f"models/{name}.onnx") for name in ("plateau", "paper"))
    return Files(folder, bag, estimate, yaml, models, flight)


def runs(files: Files, count: int) -> list[tuple[str, str, Callable[[Path], int]]]:
    """Draw ``count`` runs of programs on mutated files: program, mutation, what to call."""
    out = str(files.folder / "out.mcap")
    heading = ["-p", "alignment.heading_source:=parameter"]
    bag = str(files.bag)

    def replay_bag(path: Path) -> int:
        return replay.main([str(path), out, *heading, "--overwrite"])

    def replay_with(option: str) -> Callable[[Path], int]:
        def call(path: Path) -> int:
            given = (
                ["--params-file", str(path)] if option == "yaml" else ["-p", f"noise.model:={path}"]
            )
            return replay.main([bag, out, *heading, *given, "--overwrite"])

        return call

    def evaluate_estimate(path: Path) -> int:
        return evaluate.main([str(path), "--truth", bag])

    def evaluate_truth(path: Path) -> int:
        return evaluate.main([str(files.estimate), "--truth", str(path)])

    short = ["--search", "0.2", "--longest", "10"]

    def calibrate_bag(path: Path) -> int:
        return calibrate.main(
            [str(path), *short, "--out", str(files.folder / "out.yaml"), "--overwrite"]
        )

    def calibrate_with(path: Path) -> int:
        return calibrate.main([bag, "--params-file", str(path), *short])

    def play(path: Path) -> int:
        from hybrid_ins.cli import play

        return play.main([str(path), "--rate", "1000", "--wait", "0", "--no-clock"])

    def start_node(path: Path) -> int:
        from hybrid_ins.ros import node

        enough = threading.Timer(NODE_RUNS, os.kill, (os.getpid(), signal.SIGINT))
        enough.daemon = True
        enough.start()
        given = (
            ["--params-file", str(path)]
            if path.suffix == ".yaml"
            else ["-p", f"noise.model:={path}"]
        )
        return node.main(["--ros-args", *given])

    def convert_flight(path: Path) -> int:
        return convert.main([str(path), out, "--overwrite"])

    def convert_map(path: Path) -> int:
        assert files.flight is not None
        return convert.main([str(files.flight), out, "--map", str(path), "--overwrite"])

    text = (*BYTES, odd_words, odd_words, odd_words, shuffle_lines)
    kinds: list[
        tuple[str, Path, Sequence[Callable[[bytes, Draw], bytes]], Callable[[Path], int], float]
    ] = [
        ("ins_replay BAG", files.bag, BYTES, replay_bag, 0.25),
        ("ins_evaluate ESTIMATE", files.estimate, BYTES, evaluate_estimate, 0.1),
        ("ins_evaluate --truth BAG", files.bag, BYTES, evaluate_truth, 0.1),
        ("ins_calibrate BAG", files.bag, BYTES, calibrate_bag, 0.05),
        ("ins_replay --params-file", files.yaml, text, replay_with("yaml"), 0.2),
        ("ins_calibrate --params-file", files.yaml, text, calibrate_with, 0.02),
        *(
            ("ins_replay noise.model", model, BYTES, replay_with("model"), 0.1)
            for model in files.models
        ),
        ("ins_play BAG", files.bag, BYTES, play, 0.05),
        ("ins_node --params-file", files.yaml, text, start_node, 0.1),
        ("ins_node noise.model", files.models[0], BYTES, start_node, 0.02),
    ]
    layout = share_path("config/datasets/quadrotor.yaml")
    if files.flight is not None:
        kinds.append(("ins_convert --map", layout, text, convert_map, 0.05))
    drawn: list[tuple[str, str, Callable[[Path], int]]] = []
    for number, (name, source, mutations, call, share) in enumerate(kinds):
        data = source.read_bytes()
        for k in range(max(round(share * count), 1)):
            rng = np.random.default_rng([number, k])
            mutation = mutations[k % len(mutations)]
            drawn.append(
                (
                    name,
                    f"{mutation.__name__} {k}",
                    _on(call, mutation(data, rng), files.folder / f"mutated{source.suffix}"),
                )
            )
    for title, data in made_up_yaml().items():
        drawn.append(
            (
                "ins_replay --params-file",
                title,
                _on(replay_with("yaml"), data, files.folder / "mutated.yaml"),
            )
        )
    if files.flight is not None:
        tables = sorted(files.flight.glob("*.csv"))[:2]
        for k in range(max(round(0.05 * count), 1)):
            rng = np.random.default_rng([99, k])
            drawn.append(
                (
                    "ins_convert FLIGHT",
                    f"{BYTES[k % len(BYTES)].__name__} {k}",
                    _on_flight(
                        convert_flight, files, tables[k % len(tables)], BYTES[k % len(BYTES)], rng
                    ),
                )
            )
    return drawn


def _on(call: Callable[[Path], int], data: bytes, path: Path) -> Callable[[Path], int]:
    def run(_folder: Path) -> int:
        path.write_bytes(data)
        return call(path)

    return run


def _on_flight(
    call: Callable[[Path], int],
    files: Files,
    table: Path,
    mutation: Callable[[bytes, Draw], bytes],
    rng: Draw,
) -> Callable[[Path], int]:
    def run(folder: Path) -> int:
        assert files.flight is not None
        copy = folder / "flight"
        shutil.copytree(files.flight, copy, dirs_exist_ok=True)
        (copy / table.name).write_bytes(mutation(table.read_bytes(), rng))
        return call(copy)

    return run


def attempt(name: str, mutation: str, call: Callable[[Path], int], files: Files) -> Outcome:
    """Run one in a child process, which may do what it likes."""
    log = files.folder / "log.txt"
    out = files.folder / "out.mcap"
    out.unlink(missing_ok=True)
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        _in_child(call, files.folder, log)
    started = time.monotonic()
    while True:
        done, raw = os.waitpid(child, os.WNOHANG)
        if done:
            break
        if time.monotonic() - started > PATIENCE:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return Outcome(name, mutation, -signal.SIGKILL, "", f"hangs for {PATIENCE:g} s")
        time.sleep(0.005)
    status = os.waitstatus_to_exitcode(raw)
    words = log.read_text(errors="replace")
    return Outcome(name, mutation, status, words, _trouble(status, words, out))


def _in_child(call: Callable[[Path], int], folder: Path, log: Path) -> None:
    status = 99
    with log.open("w") as output:
        os.dup2(output.fileno(), 1)
        os.dup2(output.fileno(), 2)
        sys.stdout = sys.stderr = output
        try:
            status = call(folder)
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else 1
        except BaseException:
            traceback.print_exc()
        finally:
            with contextlib.suppress(OSError, ValueError):
                output.flush()
            os._exit(status)


def _trouble(status: int, words: str, out: Path) -> str:
    if status < 0:
        return f"ended by signal {-status}"
    if "Traceback" in words or status == 99:
        return "traceback: " + words.strip().splitlines()[-1]
    if status != 0:
        lines = [line for line in words.splitlines() if "error" in line]
        return "" if lines else "no line says why"
    if out.exists():
        with BagReader(out) as bag:
            if "/odometry" in bag.topics:
                tails = b"".join(bytes(data[-680:]) for _, _, data in bag.raw("/odometry"))
                if not np.isfinite(np.frombuffer(tails, "<f8")).all():
                    return "NaN in the result"
    return ""


def empty_bags(files: Files) -> list[tuple[str, str, Callable[[Path], int]]]:
    """Return runs on bags that hold nothing, or nothing of use."""

    def without_topics(path: Path) -> None:
        with BagWriter(path, overwrite=True):
            pass

    def other_type(path: Path) -> None:
        with BagWriter(path, overwrite=True) as bag:
            bag.write("/imu/data", new_message("sensor_msgs/msg/NavSatFix"), 1)
            bag.write("/gnss/fix", new_message("sensor_msgs/msg/Imu"), 1)

    def one_message(path: Path) -> None:
        with BagWriter(path, overwrite=True) as bag:
            bag.write("/imu/data", new_message("sensor_msgs/msg/Imu"), 1)
            bag.write("/gnss/fix", new_message("sensor_msgs/msg/NavSatFix"), 1)

    def nan_only(path: Path) -> None:
        with BagWriter(path, overwrite=True) as bag:
            imu, fix = new_message("sensor_msgs/msg/Imu"), new_message("sensor_msgs/msg/NavSatFix")
            for k in range(1, 300):
                imu.header.stamp.sec = fix.header.stamp.sec = k
                imu.linear_acceleration.x = fix.latitude = math.nan
                bag.write("/imu/data", imu, k)
                bag.write("/gnss/fix", fix, k)

    drawn = []
    path = files.folder / "made.mcap"
    for make in (without_topics, other_type, one_message, nan_only):
        for name, call in (
            (
                "ins_replay BAG",
                lambda f: replay.main([str(path), str(f / "out.mcap"), "--overwrite"]),
            ),
            ("ins_evaluate ESTIMATE", lambda f: evaluate.main([str(path)])),
            ("ins_calibrate BAG", lambda f: calibrate.main([str(path)])),
        ):

            def run(
                folder: Path,
                make: Callable[[Path], None] = make,
                call: Callable[[Path], int] = call,
            ) -> int:
                make(path)
                return call(folder)

            drawn.append((name, make.__name__, run))
    return drawn


def main(argv: Sequence[str] | None = None) -> int:
    """Run them."""
    parser = program.parser("mutate_files", __doc__ or "")
    parser.add_argument(
        "--count",
        type=options.positive_count,
        default=400,
        metavar="N",
        help="about so many mutations [%(default)s]",
    )
    parser.add_argument(
        "--flight",
        type=options.path,
        metavar="DIR",
        help="flight of the quadrotor dataset, for ins_convert",
    )
    return program.run(_body, parser.parse_args(argv))


def _body(args: argparse.Namespace) -> int:
    progress.hide()
    os.environ.update(isolated_ros())
    outcomes = []
    with tempfile.TemporaryDirectory() as folder:
        with contextlib.redirect_stdout(None):
            files = make_files(Path(folder), args.flight)
        drawn = [*runs(files, args.count), *empty_bags(files)]
        for name, mutation, call in tqdm(drawn, disable=None):
            outcomes.append(attempt(name, mutation, call, files))
    print(f"{'':30}{'runs':>6}{'refused':>9}{'result':>8}{'wrong':>7}")
    for name in dict.fromkeys(outcome.program for outcome in outcomes):
        mine = [outcome for outcome in outcomes if outcome.program == name]
        wrong = Counter(bool(outcome.trouble) for outcome in mine)[True]
        fine = [outcome for outcome in mine if not outcome.trouble]
        refused = sum(outcome.status != 0 for outcome in fine)
        print(f"{name:30}{len(mine):6}{refused:9}{len(fine) - refused:8}{wrong:7}")
    for outcome in outcomes:
        if outcome.trouble:
            print(f"WRONG {outcome.program}, {outcome.name}: {outcome.trouble}")
    wrong = sum(bool(outcome.trouble) for outcome in outcomes)
    print(f"{len(outcomes)} runs, {wrong} wrong")
    return int(wrong > 0)


if __name__ == "__main__":
    raise SystemExit(main())
