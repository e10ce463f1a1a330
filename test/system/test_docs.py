"""What the documentation says is so: links, commands, parameters, topics, layouts, policy."""

import ast
import importlib
import io
import json
import re
import subprocess
import sys
from contextlib import redirect_stdout
from functools import cache
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import yaml
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from support.paths import ROOT

from hybrid_ins import parameters
from hybrid_ins.bags.messages import new_message
from hybrid_ins.cli import replay, simulate
from hybrid_ins.parameters import parameter_file
from hybrid_ins.ros.messages.interface import SUBSCRIBED
from hybrid_ins.ros.output.message_types import OUTPUTS
from tools import generate_docs, tutorial
from tools.processes import program

PAGES = sorted(
    path
    for folder in (".", "docs", "models", "config/viewers")
    for path in (ROOT / folder).glob("*.md")
)
INPUTS = {topic.name: topic.type_name for topic in SUBSCRIBED if topic.name[0] != "/"}
TOPICS = {
    "/" + name.lstrip("/"): type_name
    for name, type_name in {
        **INPUTS,
        **OUTPUTS,
        "truth/odometry": "nav_msgs/msg/Odometry",
    }.items()
}


def name_of(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.fixture(params=PAGES, ids=name_of)
def page(request: pytest.FixtureRequest) -> Path:
    return Path(request.param)


def commands(page: Path) -> list[str]:
    """The lines of a page's code blocks, continued ones joined, and its code in the text."""
    text = page.read_text(encoding="utf-8")
    blocks = re.findall(r"^```[a-z]*\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    lines = "\n".join(blocks) + "\n" + "\n".join(re.findall(r"^    (.*)$", text, re.MULTILINE))
    return lines.replace("\\\n", " ").splitlines() + re.findall(r"`([^`\n]+)`", text)


@cache
def help_of(name: str) -> str:
    if name == "ins_node":
        return subprocess.run(
            [program(name), "--help"], stdout=subprocess.PIPE, text=True, check=True, timeout=60
        ).stdout
    shown = io.StringIO()
    with redirect_stdout(shown), pytest.raises(SystemExit):
        importlib.import_module(f"hybrid_ins.cli.{name.removeprefix('ins_')}").main(["--help"])
    return shown.getvalue()


class TestPages:
    def test_links_lead_to_something(self, page: Path) -> None:
        text = page.read_text(encoding="utf-8")
        for target in re.findall(r"\]\(([^)\s]+)\)|src=\"([^\"]+)\"", text):
            link = "".join(target)
            if link.startswith(("http:", "https:")):
                continue
            file, _, anchor = link.partition("#")
            there = (page.parent / file).resolve() if file else page
            assert there.exists(), link
            if anchor:
                assert anchor in anchors(there), link

    def test_programs_and_their_options_exist(self, page: Path) -> None:
        for line in commands(page):
            for name, rest in re.findall(r"(?:^|[\s/])(ins_[a-z]+)\b(?![./])([^|;#]*)", line):
                if not (Path(program(name))).exists():
                    assert name in ("ins_filter",), line
                    continue
                for option in re.findall(r"(?:^|\s)(--[a-z-]+)", rest.partition("--ros-args")[0]):
                    assert option in help_of(name), f"{name} has no {option}: {line}"

    def test_modules_and_files_exist(self, page: Path) -> None:
        for line in commands(page):
            for module in re.findall(r"python3? -m ((?:tools|hybrid_ins)[\w.]*)", line):
                path = ROOT.joinpath(*module.split("."))
                assert path.with_suffix(".py").is_file() or (path / "__main__.py").is_file(), line
            for module in re.findall(r"^(hybrid_ins(?:\.\w+){2,}|tools(?:\.\w+)+)$", line):
                assert resolves(module), line
            for file in re.findall(r"(?:^|[\s(])([\w.-]+(?:/[\w.-]+)*\.(?:py|sh))\b", line):
                file = file.removeprefix("src/hybrid_ins/")  # in a workspace
                places = (ROOT, ROOT / "hybrid_ins", ROOT / "tools", page.parent)
                assert "/" not in file or any((place / file).is_file() for place in places), line

    def test_launch_files_and_their_arguments_exist(self, page: Path) -> None:
        for line in commands(page):
            for file, rest in re.findall(r"ros2 launch hybrid_ins (\S+)([^#]*)", line):
                source = (ROOT / "launch" / file).read_text(encoding="utf-8")
                for argument in re.findall(r"(\w+):=", rest):
                    assert f'"{argument}"' in source, line

    def test_parameters_exist(self, page: Path) -> None:
        groups = {name.partition(".")[0] for name in parameters.PARAMETERS if "." in name}
        for line in commands(page):
            named = re.findall(r"-p '?\"?([a-z_.]+):=", line)
            if re.fullmatch(rf"({'|'.join(groups)})(\.[a-z_]+)+", line):
                named.append(line)
            for name in named:
                assert name in parameters.PARAMETERS, line


def test_every_page_is_reached_from_the_readme() -> None:
    reached, waiting = set[Path](), [ROOT / "README.md"]
    while waiting:
        page = waiting.pop()
        reached.add(page)
        for link in re.findall(r"\]\(([^)\s#]+)", page.read_text(encoding="utf-8")):
            there = (page.parent / link).resolve()
            pages = there.glob("*.md") if there.is_dir() else [there]
            waiting += [p for p in pages if p.suffix == ".md" and p not in reached and p.is_file()]

    assert not set(PAGES) - reached


def resolves(name: str) -> bool:
    """Tell whether a dotted name is a module, or an object in one."""
    for depth in range(name.count(".") + 1):
        module, *names = name.rsplit(".", depth)
        try:
            found = importlib.import_module(module)
        except ModuleNotFoundError:
            continue
        for part in names:
            if not hasattr(found, part):
                return False
            found = getattr(found, part)
        return True
    return False


def anchors(page: Path) -> set[str]:
    """The anchors that GitHub makes of a page's headings."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {
        re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings
    }


def test_the_installation_names_what_the_package_needs() -> None:
    assigned = {
        node.targets[0].id: ast.literal_eval(node.value)
        for node in ast.parse((ROOT / "setup.py").read_text(encoding="utf-8")).body
        if isinstance(node, ast.Assign)
        and isinstance(node.targets[0], ast.Name)
        and node.targets[0].id in ("NODE", "OFFLINE", "EXTRAS")
    }
    required = {*assigned["NODE"], *assigned["OFFLINE"], *assigned["EXTRAS"]["plot"]}
    names = sorted(re.split("[<>=]", item)[0].lower() for item in required)
    for name in ("tools/workspace.sh", "docs/installation.md"):
        text = (ROOT / name).read_text(encoding="utf-8")
        (line,) = re.findall(r"venv/bin/pip\"? install '(numpy<2)' ([\w ]+)$", text, re.MULTILINE)

        assert sorted(["numpy", *line[1].lower().split()]) == names, name


def test_what_is_written_from_the_declarations_is_current() -> None:
    assert generate_docs.main(["--check"]) == 0


@pytest.mark.parametrize(
    ("shown", "printed", "same"),
    [
        ("error 2.43 m", "error  2.44 m", True),  # rounding
        ("error 2.43 m", "error 2.49 m", False),
        ("offset +0.1083 s", "offset +0.1084 s", True),
        ("143 fixes", "147 fixes", False),
        ("identified", "weak", False),
    ],
)
def test_the_tutorials_check_can_fail(shown: str, printed: str, same: bool) -> None:
    assert bool(tutorial.differences(shown, printed)) is not same


@pytest.mark.parametrize(
    "path", sorted((ROOT / "config" / "vehicles").glob("*.yaml")), ids=lambda path: path.name
)
def test_vehicles_are_parameter_files(path: Path) -> None:
    values = parameter_file.load(path)

    assert values != parameters.defaults()


def test_messages_in_troubleshooting_are_the_programs_own() -> None:
    text = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
    quoted = [
        span for line in re.findall(r"^> (.*)$", text, re.M) for span in re.findall("`(.+?)`", line)
    ]
    constants = "\n".join(
        node.value
        for path in (*(ROOT / "hybrid_ins").rglob("*.py"), *(ROOT / "tools").glob("*.py"))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    )
    script = (ROOT / "tools" / "setup.sh").read_text(encoding="utf-8")

    assert len(quoted) > 15
    for message in quoted:
        for part in message.split("…"):
            assert part.strip() in constants + script, message


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Any]]:
    """Return what a replay of a simulated flight publishes, by topic."""
    folder = tmp_path_factory.mktemp("viewers")
    flight, estimate = str(folder / "flight"), str(folder / "estimate")
    assert simulate.main([flight, "--duration", "10", "--imu-rate", "100", "--heading", "0"]) == 0
    known = ["-p", "alignment.heading_source:=parameter", "-p", "gnss.time_offset.estimate:=false"]
    assert replay.main([flight, estimate, *known]) == 0
    messages: dict[str, list[Any]] = {}
    store = get_typestore(Stores.ROS2_JAZZY)
    with AnyReader([Path(estimate)], default_typestore=store) as reader:
        for connection, _, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            messages.setdefault(connection.topic, []).append(message)
    return messages


class TestViewers:
    FOLDER = ROOT / "config" / "viewers"

    def test_plotjuggler(self) -> None:
        layout = ElementTree.parse(self.FOLDER / "plotjuggler.xml").getroot()
        computed = {snippet.get("name") for snippet in layout.iter("snippet")}
        series = [curve.get("name") for curve in layout.iter("curve")]
        sources = [
            str(e.text) for s in layout.iter("snippet") for e in s.iter() if str(e.text)[0] == "/"
        ]

        assert len(sources) == 12
        for name in [*(n for n in series if n not in computed), *sources]:
            assert name
            if name.startswith("/diagnostics/hybrid_ins: "):
                continue  # its keys: see test_plotjuggler_diagnostics
            topic, path = split_topic(name)
            assert has_field(topic, re.sub(r"\[.*?\]", "", path).strip("/").split("/")), name

    @pytest.mark.slow
    def test_plotjuggler_diagnostics(self, published: dict[str, list[Any]]) -> None:
        layout = (self.FOLDER / "plotjuggler.xml").read_text(encoding="utf-8")
        values = {
            f"/diagnostics/{status.name}/{pair.key}"
            for message in published["/diagnostics"]
            for status in message.status
            for pair in status.values
        }

        plotted = set(re.findall(r'"(/diagnostics/[^"]+)"', layout))
        assert plotted
        assert plotted <= values

    def test_verdict_values_are_where_plotjuggler_looks(
        self, published: dict[str, list[Any]]
    ) -> None:
        for verdict in published["/gnss/verdict"]:
            names = [pair.key for pair in verdict.values]
            assert [names[k] for k in (4, 6, 7, 8, 9, 11)] == [
                "nis", "threshold", "sigma_e", "sigma_n", "sigma_u", "age",
            ]  # fmt: skip

    def test_foxglove(self) -> None:
        layout = json.loads((self.FOLDER / "foxglove.json").read_text(encoding="utf-8"))
        own = {"/ins/three_sigma"}

        assert set(leaves(layout["layout"])) == set(layout["configById"])
        for panel in layout["configById"].values():
            for path in panel.get("paths", ()):
                topic, _, fields = path["value"].partition(".")
                if topic not in own:
                    names = re.sub(r"\[.*?\](\{.*?\})?", "", fields).split(".")
                    assert has_field(topic, names), path["value"]
            for topic in panel.get("topics", ()):
                assert topic in TOPICS

    def test_rviz(self) -> None:
        manager = yaml.safe_load((self.FOLDER / "ins.rviz").read_text())["Visualization Manager"]
        shown = [item["Topic"]["Value"] for item in manager["Displays"] if "Topic" in item]
        tools = [tool["Topic"]["Value"] for tool in manager["Tools"] if "Topic" in tool]

        assert manager["Global Options"]["Fixed Frame"] == parameters.defaults()["map_frame"]
        for topic in (*shown, *tools):
            assert f"/{topic}" in TOPICS


def split_topic(series: str) -> tuple[str, str]:
    """The topic that a PlotJuggler series begins with, and the rest."""
    for topic in sorted(TOPICS, key=len, reverse=True):
        if series.startswith(topic + "/"):
            return topic, series[len(topic) :]
    raise AssertionError(f"{series}: of no topic")


def has_field(topic: str, fields: list[str]) -> bool:
    """Say whether a topic's message has these nested fields."""
    node = new_message(TOPICS[topic])
    for name in fields:
        if name == "values" and topic == "/gnss/verdict":
            node = new_message("diagnostic_msgs/msg/KeyValue")
        elif not hasattr(node, name):
            return False
        else:
            node = getattr(node, name)
    return True


def leaves(layout: object) -> list[str]:
    if isinstance(layout, dict):
        return leaves(layout["first"]) + leaves(layout["second"])
    return [str(layout)]


NODE = """
import json, time, rclpy
from hybrid_ins.ros.node import InsNode
rclpy.init()
node = InsNode()
node.start()
time.sleep(0.5)
graph = [
    [name for name, _ in names("ins_node", "/")]
    for names in (node.get_subscriber_names_and_types_by_node,
                  node.get_publisher_names_and_types_by_node,
                  node.get_service_names_and_types_by_node)]
print(json.dumps(graph))
"""


def test_policy_grants_what_the_node_has_and_nothing_else() -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: install the ros extra")
    profile = ElementTree.parse(ROOT / "config" / "sros2" / "policy.xml").find(".//profile")
    assert profile is not None

    def granted(path: str) -> set[str]:
        return {
            str(element.text).replace("~", "/ins_node")
            if str(element.text)[0] in "/~"
            else f"{profile.get('ns')}{element.text}"
            for element in profile.iterfind(path)
        }

    output = subprocess.run(
        [sys.executable, "-c", NODE], stdout=subprocess.PIPE, text=True, check=True, timeout=120
    ).stdout
    subscribed, published, served = map(set, json.loads(output.splitlines()[-1]))

    # /clock is heard with use_sim_time only; tf2 and gps_msgs may be absent
    assert granted("topics[@subscribe]/topic") == subscribed | {
        "/clock",
        "/gnss/gpsfix",
        "/tf_static",
    }
    assert granted("topics[@publish]/topic") == published | {"/tf"}
    # robot_localization has the types of these
    geographic = {"/fromLL", "/toLL", "/fromLLArray", "/datum"}
    assert granted("services[@reply]/service") == served | geographic
