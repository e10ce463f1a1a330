"""Arrows point inward only: what each part of the package may import."""

import ast
import importlib
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest
from support.paths import ROOT

from hybrid_ins import parameters
from tools import structure
from tools.structure import is_below

MODULES = structure.read_modules()
CORE = {name for name in MODULES if name.startswith("hybrid_ins.core")}
OUTER = {"hybrid_ins.ros.node", "hybrid_ins.ros.player", "hybrid_ins.ros.recorder"}
LIBRARIES = 3
FLOORS = {
    **dict.fromkeys(
        ("core", "errors", "output_file", "progress", "resources", "row_file", "yaml_reader"), 0
    ),
    **dict.fromkeys(("parameters", "kernel_cache", "noise_regressor"), 1),
    "ros": 2,
    "cli": 4,
}
"""Floors of the package; all others are libraries."""
NOT_FOR_EVERYONE = {
    "onnxruntime": {"hybrid_ins.noise_regressor.onnx_model"},
    "rclpy": OUTER
    | {f"hybrid_ins.ros.{m}" for m in ("geographic_services", "live_estimator", "status_listener")},
    "rosbags": {name for name in MODULES if name.startswith("hybrid_ins.bags.")},
    "matplotlib": {name for name in MODULES if name.startswith("hybrid_ins.plotting.")},
}


Nodes = Mapping[str, structure.Module] | Mapping[str, structure.Part]


def imports(module: str) -> frozenset[str]:
    return MODULES[module].imports


def cycles(names: Nodes) -> set[str]:
    return structure.in_cycles({name: node.imports for name, node in names.items()})


@pytest.mark.parametrize("module", sorted(CORE))
def test_core_imports_numpy_numba_and_itself_only(module: str) -> None:
    allowed = {"numpy", "numba", *sys.stdlib_module_names}

    others = {name for name in imports(module) if name.partition(".")[0] not in allowed}

    assert all(is_below(name, "hybrid_ins.core") for name in others), others


@pytest.mark.parametrize("library", sorted(NOT_FOR_EVERYONE))
def test_library_stays_in_its_place(library: str) -> None:
    users = {m for m in MODULES if any(is_below(name, library) for name in imports(m))}

    assert users <= NOT_FOR_EVERYONE[library]


def test_nothing_imports_the_node_or_the_player() -> None:
    users = {m for m in MODULES if OUTER & set(imports(m)) - {m}}

    assert users <= {"hybrid_ins.cli.node", "hybrid_ins.playback", "hybrid_ins.ros.recorder"}


def floor(module: str) -> int:
    """Return the floor of a module, which may import its own and lower ones."""
    if module == "hybrid_ins.ros.node":  # a program, too
        return FLOORS["cli"]
    return FLOORS.get(module.split(".")[1], LIBRARIES) if "." in module else 0


@pytest.mark.parametrize("module", sorted(MODULES))
def test_arrows_point_to_the_same_floor_or_down(module: str) -> None:
    higher = {m for m in imports(module) if m in MODULES and floor(m) > floor(module)}

    assert not higher


def test_nothing_but_programs_imports_a_program() -> None:
    users = {m for m in MODULES if any(is_below(name, "hybrid_ins.cli") for name in imports(m))}

    assert all(floor(m) == FLOORS["cli"] for m in users), users


@pytest.mark.parametrize("names", [MODULES, structure.parts(MODULES)], ids=["modules", "folders"])
def test_no_import_goes_in_a_circle(names: Nodes) -> None:
    assert not cycles(names)


def test_no_more_files_and_classes_are_long() -> None:
    assert not structure.long_files(MODULES)
    assert not structure.long_classes(MODULES)


def defined(path: Path) -> Iterator[str]:
    """Yield the names of functions, classes and variables that a file defines, at any depth."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.id if isinstance(node, ast.Name) else node.attr
        elif isinstance(node, ast.ImportFrom) and path.stem == "__init__":
            yield from (alias.name for alias in node.names)


def test_texts_refer_to_what_there_is() -> None:
    paths = sorted((ROOT / "hybrid_ins").rglob("*.py"))
    names: dict[str, set[str]] = {}  # by the end of a module's name, or by that of a class
    for path in paths:
        parts = path.relative_to(ROOT).with_suffix("").parts
        if parts[-1] == "__init__":
            parts = parts[:-1]
        own = set(defined(path))
        for key in [".".join(parts[k:]) for k in range(len(parts))] + list(own):
            names.setdefault(key, set()).update(own)

    def is_found(text: str) -> bool:
        head, _, tail = text.rpartition(".")
        if text in names or text in parameters.defaults() or tail in names.get(head, ()):
            return True
        try:
            return hasattr(importlib.import_module({"np": "numpy"}.get(head, head)), tail)
        except ImportError:
            return False

    missing = [
        (path.name, text)
        for path in paths
        for text in re.findall(r"(?<!`)`([A-Za-z]\w*(?:\.\w+)+)`(?!`)", path.read_text())
        if not is_found(text)
    ]

    assert not missing


def test_an_imu_message_is_a_few_steps_from_the_covariance_equation() -> None:
    road = structure.imu_road()

    assert road[0] == "ros/live_estimator.py: _on_imu"
    assert road[-1] == "core/inertial/_covariance_step.py: covariance_step"
    assert len({step.partition(":")[0] for step in road[:-1]}) <= 5
    assert len(road) <= 7


def test_a_cycle_and_what_is_too_long_are_found(tmp_path: Path) -> None:
    package = tmp_path / "some"
    package.mkdir()
    for name, text in {
        "__init__": "",
        "a": "from some import b",
        "b": "from .c import thing",
        "c": "import some.a\nthing = 1",
        "d": "from some import b\n" + "x = 1\n" * 400,
        "e": "class Long:\n" + "    x = 1\n" * 250,
    }.items():
        (package / f"{name}.py").write_text(text)

    modules = structure.read_modules(tmp_path, "some")

    assert cycles(modules) == {"some.a", "some.b", "some.c", "some.d"}
    assert structure.long_files(modules) == {"some.d": 401}
    assert structure.long_classes(modules) == {"some.e.Long": 251}


def test_folders_that_import_each_other_are_found(tmp_path: Path) -> None:
    for name, text in {
        "hybrid_ins/x/a": "from hybrid_ins.y import b",
        "hybrid_ins/x/c": "",
        "hybrid_ins/y/b": "",
        "hybrid_ins/y/d": "import hybrid_ins.x.c",
        "hybrid_ins/e": "import hybrid_ins.y.b",
        "hybrid_ins/y/f": "import hybrid_ins.g",
        "hybrid_ins/g": "",
    }.items():
        path = tmp_path / f"{name}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    modules = structure.read_modules(tmp_path)

    assert not cycles(modules)
    assert cycles(structure.parts(modules)) == {f"hybrid_ins.{part}" for part in "xye"}


def test_dictionary_imports_nothing() -> None:
    assert not imports("hybrid_ins")


def test_importing_the_core_loads_no_outer_library() -> None:
    code = f"import sys, {', '.join(sorted(CORE))}; print(*sys.modules)"

    loaded = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout.split()

    assert not {"rclpy", "onnxruntime", "rosbags", "matplotlib", "tqdm"} & set(loaded)
