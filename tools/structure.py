"""
The structure of the package in figures: sizes, imports between its parts, and the IMU's road.

    python -m tools.structure

The road of an IMU message is traced, not written down: the functions of the package that are
active, the outer one first, when the covariance equation is evaluated for a message.
"""

from __future__ import annotations

import ast
import math
import os
import subprocess
import sys
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
NAME = "hybrid_ins"
GENERATED = (f"{NAME}.core.inertial._covariance_step",)
LONG_FILE, LONG_CLASS = 400, 250  # lines
TRACE = "trace"  # the argument of the process that is traced


@dataclass(frozen=True)
class Module:
    """
    One module of the package.

    Attributes
    ----------
    lines : int
        Lines of its file.
    classes : dict of str to int
        Lines of each class.
    imports : frozenset of str
        Full name of everything that it imports, anywhere in its text.
    """

    lines: int
    classes: Mapping[str, int]
    imports: frozenset[str]


def read_modules(root: Path = ROOT, name: str = NAME) -> dict[str, Module]:
    """Return every module of a package below a folder, by its full name."""
    paths = {
        ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__"): path
        for path in sorted((root / name).rglob("*.py"))
    }
    return {module: _read(module, path, paths) for module, path in paths.items()}


def _read(module: str, path: Path, known: Mapping[str, Path]) -> Module:
    text = path.read_text(encoding="utf-8")
    nodes = list(ast.walk(ast.parse(text)))
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    classes = {
        node.name: (node.end_lineno or node.lineno) - node.lineno + 1
        for node in nodes
        if isinstance(node, ast.ClassDef)
    }
    return Module(len(text.splitlines()), classes, frozenset(_imports(nodes, package, known)))


def _imports(nodes: list[ast.AST], package: str, known: Mapping[str, Path]) -> Iterator[str]:
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")[: len(package.split(".")) - node.level + 1]
            base = ".".join([*(parents if node.level else []), *filter(None, [node.module])])
            for alias in node.names:
                inner = f"{base}.{alias.name}"
                yield inner if inner in known else base


def is_below(name: str, package: str) -> bool:
    """Return whether a name is a package or anything in it."""
    return name == package or name.startswith(package + ".")


def in_cycles(imports: Mapping[str, Collection[str]]) -> set[str]:
    """Return the names that import each other in a circle, and those that import from one."""
    left = {name: imports.keys() & needed - {name} for name, needed in imports.items()}
    while leaves := {name for name, needed in left.items() if not needed & left.keys()}:
        left = {name: needed for name, needed in left.items() if name not in leaves}
    return set(left)


def long_files(modules: Mapping[str, Module]) -> dict[str, int]:
    """Return the lines of the files that are too long; generated ones do not count."""
    return {
        name: m.lines
        for name, m in modules.items()
        if m.lines > LONG_FILE and name not in GENERATED
    }


def long_classes(modules: Mapping[str, Module]) -> dict[str, int]:
    """Return the lines of the classes that are too long."""
    return {
        f"{name}.{kind}": lines
        for name, m in modules.items()
        for kind, lines in m.classes.items()
        if lines > LONG_CLASS
    }


class Part(NamedTuple):
    """A folder of the package, without those in it, or a file that lies beside the folders."""

    files: int
    lines: int
    imports: frozenset[str]  # other parts


def parts(modules: Mapping[str, Module]) -> dict[str, Part]:
    """Return every part of the package, by its full name."""
    folders = {name.rpartition(".")[0] for name in modules} - {"", NAME}

    def part_of(module: str) -> str:
        folder = module.rpartition(".")[0]
        return folder if folder in folders and module not in folders else module

    found: dict[str, Part] = {}
    for name, module in modules.items():
        files, lines, imports = found.get(part_of(name), Part(0, 0, frozenset()))
        others = {part_of(other) for other in module.imports & modules.keys()} - {part_of(name)}
        found[part_of(name)] = Part(files + 1, lines + module.lines, imports | others)
    return found


def imu_road() -> list[str]:
    """
    Return the functions between an IMU message and the covariance equation, outer ones first.

    Raises
    ------
    subprocess.CalledProcessError
        The filter did not start.
    """
    node = ast.parse((ROOT / NAME / "ros" / "live_estimator.py").read_text(encoding="utf-8"))
    callbacks = [
        f"ros/live_estimator.py: {function.name}"
        for function in ast.walk(node)
        if isinstance(function, ast.FunctionDef) and "handle_imu" in _attributes(function)
    ]
    traced = subprocess.run(
        [sys.executable, __file__, TRACE],
        # Compiled functions cannot be traced; and `tools` would keep machine code.
        env=os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(ROOT)},
        check=True,
        capture_output=True,
        text=True,
    )
    return [*callbacks, *traced.stdout.splitlines()]


def _attributes(function: ast.FunctionDef) -> set[str]:
    return {node.attr for node in ast.walk(function) if isinstance(node, ast.Attribute)}


def _trace() -> None:
    """Print the functions that are active in the covariance's step of a filter that runs."""
    from hybrid_ins import parameters
    from hybrid_ins.bags.messages import new_message
    from hybrid_ins.ros.estimator.estimator import Estimator
    from hybrid_ins.ros.messages.cdr import ImuFields
    from hybrid_ins.ros.messages.conversions import set_stamp

    given = {"alignment.heading_source": "parameter", "noise.mode": "constant"}
    estimator = Estimator(parameters.check_all(given), lambda level, text: None)
    fix = new_message("sensor_msgs/msg/NavSatFix")
    fix.latitude, fix.longitude = 32.1, 34.8
    found: list[str] = []

    def watch(frame: FrameType, event: str, _: object) -> None:
        if event != "call" or frame.f_code.co_name != "covariance_step" or found:
            return
        caller: FrameType | None = frame
        while caller is not None:
            path = Path(caller.f_code.co_filename)
            if path.is_relative_to(ROOT / NAME):
                place = path.relative_to(ROOT / NAME)
                found.insert(0, f"{place}: {caller.f_code.co_name}")
            caller = caller.f_back

    for k in range(1, 1000):
        t_ns = k * 10_000_000
        if estimator.aligned:
            sys.setprofile(watch)
        noise = 1e-3 * math.sin(k)  # without any the sensor is taken to be frozen
        estimator.handle_imu(ImuFields(t_ns, (noise, -noise, 9.8), (noise, -noise, noise)))
        estimator.run_periodic()
        sys.setprofile(None)
        if found:
            break
        if k % 20 == 0:
            set_stamp(fix.header.stamp, t_ns)
            estimator.handle_fix(fix)
    print("\n".join(found))
    if not found:
        raise SystemExit("the filter did not start")


def main() -> int:
    """Print the figures."""
    if sys.argv[1:] == [TRACE]:
        _trace()
        return 0
    if sys.argv[1:]:
        print(f"structure: error: {sys.argv[1]}: there are no arguments", file=sys.stderr)
        return 2
    modules = read_modules()
    lines = sum(m.lines for m in modules.values())
    print(f"{len(modules)} files, {lines} lines\n")
    print("part, files, lines, what it imports of the others")
    for name, part in parts(modules).items():
        short = " ".join(other.removeprefix(f"{NAME}.") for other in sorted(part.imports))
        print(f"  {name.removeprefix(f'{NAME}.'):20} {part.files:3} {part.lines:6}  {short}")
    for title, found in (
        (f"files over {LONG_FILE} lines", long_files(modules)),
        (f"classes over {LONG_CLASS} lines", long_classes(modules)),
    ):
        print(f"\n{title}: {len(found)}")
        for name, count in sorted(found.items(), key=lambda item: -item[1]):
            print(f"  {count:5} {name}")
    for title, names in (("modules", modules), ("parts", parts(modules))):
        cycles = in_cycles({name: node.imports for name, node in names.items()})
        print(f"\n{title} in import cycles: {len(cycles)}")
    print("\nfrom an IMU message to the covariance equation:")
    for step in imu_road():
        print(f"  {step}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
