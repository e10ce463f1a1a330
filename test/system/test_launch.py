"""The launch files start programs that are there, and say what their arguments are for."""

import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from support.paths import ROOT

from tools.processes import program

FILES = sorted((ROOT / "launch").glob("*.launch.py"))
MODULES = (
    "launch", "launch.actions", "launch.conditions", "launch.event_handlers",
    "launch.launch_description_sources", "launch.substitutions",
    "launch_ros", "launch_ros.actions", "launch_ros.substitutions",
)  # fmt: skip


class Recorded:
    """Whatever a launch file makes: a class's name, and what it was given."""

    def __init__(self, kind: str, given: tuple[Any, ...], named: dict[str, Any]) -> None:
        self.kind, self.given, self.named = kind, given, named

    def all(self) -> Iterator["Recorded"]:
        yield self
        waiting: list[Any] = [*self.given, *self.named.values()]
        while waiting:
            item = waiting.pop()
            if isinstance(item, Recorded):
                yield from item.all()
            elif isinstance(item, dict):
                waiting += [*item, *item.values()]
            elif isinstance(item, list | tuple) or type(item).__name__ == "dict_items":
                waiting += list(item)


class StandIn(ModuleType):
    """Stands in for a module of launch, which comes with ROS only."""

    def __getattr__(self, kind: str) -> Any:
        if kind.startswith("__"):
            raise AttributeError(kind)
        return lambda *given, **named: Recorded(kind, given, named)


def description_of(path: Path) -> Any:
    spec = importlib.util.spec_from_file_location(path.name.replace(".", "_"), path)
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.generate_launch_description()


@pytest.fixture(params=FILES, ids=lambda path: path.name)
def parts(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> list[Recorded]:
    """All that a launch file describes, made with stand-ins."""
    for name in MODULES:
        monkeypatch.setitem(sys.modules, name, StandIn(name))
    return list(description_of(request.param).all())


def declared(parts: list[Recorded]) -> set[str]:
    return {part.given[0] for part in parts if part.kind == "DeclareLaunchArgument"}


def test_arguments_used_are_declared_and_described(parts: list[Recorded]) -> None:
    used = {part.given[0] for part in parts if part.kind == "LaunchConfiguration"}

    assert used == declared(parts)
    for part in parts:
        if part.kind == "DeclareLaunchArgument":
            assert part.named["description"]


def test_programs_started_exist(parts: list[Recorded]) -> None:
    for part in parts:
        if part.kind == "Node" and part.named["package"] == "hybrid_ins":
            assert Path(program(part.named["executable"])).exists()
        if part.kind == "ExecutableInPackage":
            name, package = part.given
            assert package == "hybrid_ins"
            assert Path(program(name)).exists()


def test_included_files_exist_and_take_what_they_are_given(
    parts: list[Recorded], monkeypatch: pytest.MonkeyPatch
) -> None:
    for part in parts:
        if part.kind != "IncludeLaunchDescription":
            continue
        path = next(p for p in part.all() if p.kind == "PathJoinSubstitution").given[0]
        included = ROOT / Path(*[word for word in path if isinstance(word, str)])
        given = {name for name, _ in part.named["launch_arguments"]}

        assert given <= declared(list(description_of(included).all()))


def test_files_shared_exist(parts: list[Recorded]) -> None:
    for part in parts:
        if part.kind == "PathJoinSubstitution":
            assert ROOT.joinpath(*[w for w in part.given[0] if isinstance(w, str)]).exists()


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_real_launch_takes_the_file(path: Path) -> None:
    pytest.importorskip("launch_ros", reason="launch_ros comes with ROS only")

    for argument in description_of(path).get_launch_arguments():
        assert argument.description, argument.name
