"""Arrows point inward only: what each part of the package may import."""

import ast
import subprocess
import sys
from collections.abc import Iterator

import pytest
from support.paths import ROOT

PACKAGE = ROOT / "hybrid_ins"
MODULES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted(PACKAGE.rglob("*.py"))
}
CORE = {name for name in MODULES if name.startswith("hybrid_ins.core")}
OUTER = {"hybrid_ins.ros.node", "hybrid_ins.ros.player"}
LIBRARIES = 3
FLOORS = {
    **dict.fromkeys(("core", "errors", "output_file", "progress", "resources", "yaml_reader"), 0),
    **dict.fromkeys(("parameter", "parameter_list", "parameters", "parameter_file"), 1),
    "noise_regressor": 1,
    "ros": 2,
    "cli": 4,
}
"""Floors of the house; all others are libraries."""
NOT_FOR_EVERYONE = {
    "onnxruntime": {"hybrid_ins.noise_regressor.models"},
    "rclpy": OUTER,
    "rosbags": {name for name in MODULES if name.startswith("hybrid_ins.bags.")},
    "matplotlib": {name for name in MODULES if name.startswith("hybrid_ins.plotting.")},
}


def imports(module: str) -> Iterator[str]:
    """Yield the full name of everything that a module imports, anywhere in its text."""
    path = MODULES[module]
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")[: len(package.split(".")) - node.level + 1]
            base = ".".join([*(parents if node.level else []), *filter(None, [node.module])])
            for alias in node.names:
                inner = f"{base}.{alias.name}"
                yield inner if inner in MODULES else base


def is_below(name: str, package: str) -> bool:
    return name == package or name.startswith(package + ".")


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

    assert users <= {"hybrid_ins.playback"}


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


def test_no_import_goes_in_a_circle() -> None:
    left = {m: {name for name in imports(m) if name in MODULES} - {m} for m in MODULES}
    while leaves := {m for m, needed in left.items() if not needed & left.keys()}:
        left = {m: needed for m, needed in left.items() if m not in leaves}

    assert not left


def test_dictionary_imports_nothing() -> None:
    assert not list(imports("hybrid_ins"))


def test_importing_the_core_loads_no_outer_library() -> None:
    code = f"import sys, {', '.join(sorted(CORE))}; print(*sys.modules)"

    loaded = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout.split()

    assert not {"rclpy", "onnxruntime", "rosbags", "matplotlib", "tqdm"} & set(loaded)
