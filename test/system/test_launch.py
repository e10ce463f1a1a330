"""
The launch files start programs that exist, and refuse what would mislead.

launch comes with a ROS installation only. Without one the launch files run against stand-ins that
record what they are given: that checks names, arguments, files and the code of the launch files,
not launch itself. `test_real_launch` needs the real one.
"""

import importlib.util
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
from support.paths import ROOT

from tools.processes import program

FILES = sorted((ROOT / "launch").glob("*.launch.py"))
MODULES = (
    "ament_index_python", "ament_index_python.packages",
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

    def perform(self, context: dict[str, str]) -> str:
        """Return a substitution's value, as launch's do."""
        if self.kind == "LaunchConfiguration":
            return context[self.given[0]]
        if self.kind == "FindPackageShare":
            return str(ROOT)
        assert self.kind == "PathJoinSubstitution"
        return str(Path(*(perform(part, context) for part in self.given[0])))


def perform(value: "str | Recorded", context: dict[str, str]) -> str:
    return value.perform(context) if isinstance(value, Recorded) else value


class StandIn(ModuleType):
    """Stands in for a module of launch, which comes with ROS only."""

    def __getattr__(self, kind: str) -> Any:
        if kind.startswith("__"):
            raise AttributeError(kind)
        return lambda *given, **named: Recorded(kind, given, named)


class PackageNotFoundError(KeyError):
    """Stands in for ament's."""


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Replace launch by stand-ins, and return the packages that ament finds: add to them."""
    packages = {"hybrid_ins"}

    def find(name: str) -> str:
        if name not in packages:
            raise PackageNotFoundError(name)
        return str(ROOT)

    for name in MODULES:
        monkeypatch.setitem(sys.modules, name, StandIn(name))
    ament: Any = sys.modules["ament_index_python.packages"]
    ament.PackageNotFoundError = PackageNotFoundError
    ament.get_package_prefix = ament.get_package_share_directory = find
    return packages


def load(path: Path) -> Any:
    spec = importlib.util.spec_from_file_location(path.name.replace(".", "_"), path)
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def described(path: Path) -> list[Recorded]:
    return list(load(path).generate_launch_description().all())


@pytest.fixture(params=FILES, ids=lambda path: path.name)
def parts(request: pytest.FixtureRequest, installed: set[str]) -> list[Recorded]:
    """All that a launch file describes, with what its functions return for the defaults."""
    return started(described(request.param))


class Context(dict[str, str]):
    """Stands in for a LaunchContext: the arguments' values, and which of them were used."""

    def __init__(self) -> None:
        super().__init__()
        self.used: set[str] = set()

    def __getitem__(self, name: str) -> str:
        self.used.add(name)
        return super().__getitem__(name)


def started(
    parts: list[Recorded], context: Context | None = None, **arguments: str
) -> list[Recorded]:
    """Return the parts and what the functions among them return for these arguments."""
    context = Context() if context is None else context
    for part in parts:
        if part.kind == "DeclareLaunchArgument" and "default_value" in part.named:
            context[part.given[0]] = perform(part.named["default_value"], {})
    context.update(arguments)
    found = list(parts)
    for part in parts:
        if part.kind == "OpaqueFunction":
            for entity in part.named["function"](context):
                found += entity.all()
        elif part.kind == "OnProcessExit":
            found += part.named["on_exit"](exited("ins_simulate-1"), context).all()
    return found


def exited(name: str, returncode: int = 0) -> SimpleNamespace:
    return SimpleNamespace(process_name=name, returncode=returncode)


def declared(parts: list[Recorded]) -> set[str]:
    return {part.given[0] for part in parts if part.kind == "DeclareLaunchArgument"}


def of(parts: list[Recorded], kind: str) -> list[Recorded]:
    return [part for part in parts if part.kind == kind]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_arguments_are_declared_described_and_used(path: Path, installed: set[str]) -> None:
    context = Context()
    parts = started(described(path), context)
    used = {part.given[0] for part in of(parts, "LaunchConfiguration")} | context.used

    assert used == declared(parts)
    for part in of(parts, "DeclareLaunchArgument"):
        assert part.named["description"]


def test_programs_started_exist(parts: list[Recorded]) -> None:
    for part in of(parts, "Node"):
        assert part.named["package"] == "hybrid_ins"
        assert Path(program(part.named["executable"])).exists()
    for part in of(parts, "ExecutableInPackage"):
        name, package = part.given
        assert package == "hybrid_ins"
        assert Path(program(name)).exists()


def test_included_files_exist_and_take_what_they_are_given(parts: list[Recorded]) -> None:
    for part in of(parts, "IncludeLaunchDescription"):
        path = next(p for p in part.all() if p.kind == "PathJoinSubstitution")
        given = {name for name, _ in part.named["launch_arguments"]}

        assert given <= declared(described(Path(path.perform({}))))


def test_files_shared_exist(parts: list[Recorded]) -> None:
    for part in of(parts, "PathJoinSubstitution"):
        assert Path(part.perform({})).exists()


LIVE = ROOT / "launch" / "live.launch.py"


class TestLive:
    def node(self, **arguments: str) -> dict[str, Any]:
        return next(
            part.named
            for part in started(described(LIVE), **arguments)
            if part.kind == "Node" and part.named["package"] == "hybrid_ins"
        )

    def test_missing_parameter_file_is_refused(self, installed: set[str]) -> None:
        with pytest.raises(RuntimeError, match=r"params_file:=/nowhere/robot\.yaml: no such file"):
            self.node(params_file="/nowhere/robot.yaml")

    def test_the_parameter_files_frames_and_clock_stay(
        self, installed: set[str], tmp_path: Path
    ) -> None:
        mine = tmp_path / "robot.yaml"
        mine.touch()

        node = self.node(params_file=str(mine))

        assert node["parameters"] == [str(mine)]

    def test_two_vehicles_have_names_and_frames_of_their_own(self, installed: set[str]) -> None:
        node = self.node(namespace="b", name="ins_b", frame_prefix="b/", use_sim_time="true")

        assert (node["namespace"], node["name"]) == ("b", "ins_b")
        assert node["parameters"][1:] == [
            {"use_sim_time": True},
            {"map_frame": "b/map", "odom_frame": "b/odom", "base_frame": "b/base_link"},
        ]

    def test_topics_are_remapped(self, installed: set[str]) -> None:
        assert ("imu/data", "/my_imu") in self.node(imu_topic="/my_imu")["remappings"]

    def test_a_lifecycle_manager_may_start_it(self, installed: set[str]) -> None:
        assert {"autostart": False} in self.node(autostart="false")["parameters"]

    def test_respawn_is_a_choice(self, installed: set[str]) -> None:
        assert self.node()["respawn"] is False
        assert self.node(respawn="true")["respawn"] is True

    def test_without_rviz_the_node_runs_and_a_line_says_so(self, installed: set[str]) -> None:
        parts = started(described(LIVE), rviz="true")

        assert [part.named["package"] for part in of(parts, "Node")] == ["hybrid_ins"]
        (line,) = of(parts, "LogInfo")
        assert "rviz2 is not installed" in line.named["msg"]

    def test_rviz_opens_with_the_layout_and_the_vehicles_map(self, installed: set[str]) -> None:
        installed.add("rviz2")
        parts = started(described(LIVE), rviz="true", frame_prefix="b/")

        _, rviz = of(parts, "Node")
        _, layout, _, frame = rviz.named["arguments"]
        assert Path(layout).is_file()
        assert frame == "b/map"


def handler(path: Path, installed: set[str]) -> Callable[..., Any]:
    (on_exit,) = of(described(path), "OnProcessExit")
    function = on_exit.named["on_exit"]
    assert callable(function)
    return function


@pytest.mark.parametrize("name", ["ins_play-2", "ins_node-1"])
def test_replay_ends_with_player_or_node(name: str, installed: set[str]) -> None:
    action = handler(ROOT / "launch" / "replay.launch.py", installed)(exited(name), None)

    assert action.kind == "Shutdown"
    assert name in action.named["reason"]


def test_rviz_may_be_closed_during_a_replay(installed: set[str]) -> None:
    assert handler(ROOT / "launch" / "replay.launch.py", installed)(exited("rviz2-3"), None) is None


def test_demo_plays_only_what_was_simulated(installed: set[str]) -> None:
    after = handler(ROOT / "launch" / "demo.launch.py", installed)

    assert after(exited("ins_simulate-1"), None).kind == "IncludeLaunchDescription"
    assert after(exited("ins_simulate-1", 2), None).kind == "Shutdown"


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_real_launch(path: Path) -> None:
    pytest.importorskip("launch_ros", reason="launch_ros comes with ROS only")

    for argument in load(path).generate_launch_description().get_launch_arguments():
        assert argument.description, argument.name
