"""
Write the parts of the documentation that are made from declarations and reports, or check them.

`config/default.yaml` and `docs/parameters.md` are made from `hybrid_ins.parameters`;
the tables in `docs/ros_interface.md` from `hybrid_ins.ros.messages.interface`; `docs/figures.md`
and the figures in `README.md` from the reports that `tools.figures` names. A test runs the check.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from hybrid_ins import parameters  # noqa: E402
from hybrid_ins.parameters import parameter_file  # noqa: E402
from hybrid_ins.parameters.declared import PARAMETERS  # noqa: E402
from hybrid_ins.parameters.parameter import Parameter  # noqa: E402
from hybrid_ins.ros.messages import interface  # noqa: E402
from tools import figures  # noqa: E402

FIRST_TO_SET = (
    "imu.mount_rpy",
    "imu.position",
    "gnss.antenna_position",
    "gnss.time_offset.value",
    "gnss.position_std_min",
    "alignment.heading_source",
    "noise.mode",
    "odometry_rate",
)
GROUPS = {
    "": "Frames and output",
    "imu": "IMU",
    "gnss": "GNSS",
    "alignment": "Alignment",
    "vehicle": "Vehicle",
    "aiding": "Aiding sensors",
    "validity": "Validity",
    "noise": "Process noise",
}
EXPERIMENTS = "Experiments"
HEADING = """\
Every parameter of ins_node with its default.

Copy this file, keep what differs, and start the node with
  ros2 run hybrid_ins ins_node --ros-args --params-file my_robot.yaml
Written by: python -m tools.generate_docs"""
PREAMBLE = """\
# Parameters

Every parameter of `ins_node`, and of `ins_replay`, which reads the same file. This page and
[config/default.yaml](../config/default.yaml) are written by `python -m tools.generate_docs`.

    ros2 run hybrid_ins ins_node --ros-args --params-file my_robot.yaml
    ros2 param describe /ins_node gnss.patience
    ros2 param set /ins_node noise.mode constant

**live** means that `ros2 param set` takes effect at once and keeps the state; a fix that was valid
before, and comes later, is still judged by the limits of then. The other parameters take effect at
the start only. The node, `ros2 param set` and the programs reject invalid values and explain why in
one line. The programs also reject unknown names; the node only warns of them,
because the section `/**` of a file may be meant for other nodes, too.
"""
EXPERIMENTS_TEXT = """\
These parameters and modes reproduce the filters of the paper for comparison. A robot does not need
them. The modes `cq1` to `cq3` are the paper's constants, `innovation` estimates the process noise
from the innovations, and `innovation_literal` does so as the paper prints it.
"""


def row(parameter: Parameter) -> str:
    """Return a parameter's row of the Markdown table."""
    kind = "live" if parameter.runtime else ""
    usual = [c for c in parameter.choices if c not in parameter.experiment_choices]
    text = parameter.text
    for words, label in ((usual, ""), (parameter.experiment_choices, "; for experiments ")):
        text += (label or " (") + ", ".join(f"`{word}`" for word in words) if words else ""
    text += ")" if parameter.choices else ""
    cells = (f"`{parameter.name}`", f"`{value(parameter.default)}`", parameter.bounds(), kind, text)
    return "| " + " | ".join(cells) + " |"


def value(default: object) -> str:
    """Return a default as one writes it in YAML."""
    if isinstance(default, bool):
        return str(default).lower()
    if isinstance(default, list):
        return "[" + ", ".join(f"{v:g}" for v in default) + "]"
    return f"{default:g}" if isinstance(default, float) else str(default)


def table(names: Sequence[str]) -> str:
    """Return the table of some parameters."""
    head = "| parameter | default | range | | meaning |\n|---|---|---|---|---|\n"
    return head + "\n".join(row(PARAMETERS[name]) for name in names) + "\n"


def page() -> str:
    """Return `docs/parameters.md`."""
    parts = [PREAMBLE, f"## The ones to set first\n\n{table(FIRST_TO_SET)}"]
    for group, title in GROUPS.items():
        members = [
            name
            for name, parameter in PARAMETERS.items()
            if (name.partition(".")[0] if "." in name else "") == group and not parameter.experiment
        ]
        parts.append(f"## {title}\n\n{table(members)}")
    experiments = [name for name, parameter in PARAMETERS.items() if parameter.experiment]
    parts.append(f"## {EXPERIMENTS}\n\n{EXPERIMENTS_TEXT}\n{table(experiments)}")
    return "\n".join(parts)


def default_file() -> str:
    """Return `config/default.yaml`."""
    return parameter_file.to_yaml(parameters.defaults(), HEADING)


def files() -> dict[Path, str]:
    """Return each generated file with what it must hold."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    readme = put_between("figures", figures.short_table(), readme)
    topics = (ROOT / "docs/ros_interface.md").read_text(encoding="utf-8")
    topics = put_between("subscribed", topics_table(interface.SUBSCRIBED), topics)
    topics = put_between("published", topics_table(interface.PUBLISHED), topics)
    topics = put_between("services", services_table(), topics)
    return {
        ROOT / "config/default.yaml": default_file(),
        ROOT / "docs/parameters.md": page(),
        ROOT / "docs/figures.md": figures.page(),
        ROOT / "docs/ros_interface.md": topics,
        ROOT / "README.md": readme,
    }


def short_type(type_name: str) -> str:
    """Return the name of a type as it is usually written: without its folder."""
    package, _, name = type_name.split("/")
    return f"{package}/{name}"


def topics_table(topics: Sequence[interface.Topic]) -> str:
    """Return a Markdown table of topics."""
    rows = [
        f"| `{t.name}` | {short_type(t.type_name)} | {quality_text(t.quality)} | {t.text} |"
        for t in topics
    ]
    return "\n".join(("| topic | type | QoS | remarks |", "|---|---|---|---|", *rows)) + "\n"


def services_table() -> str:
    """Return a Markdown table of the services."""
    rows = [f"| `{s.name}` | {short_type(s.type_name)} | {s.text} |" for s in interface.SERVICES]
    return "\n".join(("| service | type | effect |", "|---|---|---|", *rows)) + "\n"


def quality_text(quality: interface.Quality) -> str:
    """Return a quality of service in words."""
    words = ["reliable" if quality.reliable else "best effort"]
    words += ["transient local"] * quality.transient_local
    return ", ".join([*words, str(quality.depth)])


def put_between(name: str, text: str, page: str) -> str:
    """Return a page with what stands between the two marks of a name replaced by a text."""
    begin, end = f"<!-- {name}: tools/generate_docs.py -->", f"<!-- end of {name} -->"
    before, _, rest = page.partition(begin)
    return f"{before}{begin}\n{text}{end}{rest.partition(end)[2]}"


def main(argv: Sequence[str] | None = None) -> int:
    """Write the files, or with ``--check`` name those that are out of date."""
    parser = argparse.ArgumentParser(prog="generate_docs", description=__doc__.splitlines()[1])
    parser.add_argument("--check", action="store_true", help="write nothing, fail if out of date")
    args = parser.parse_args(argv)
    stale = {
        path: text
        for path, text in files().items()
        if not path.is_file() or path.read_text(encoding="utf-8") != text
    }
    for path, text in stale.items():
        name = path.relative_to(ROOT)
        if args.check:
            print(f"{name} is out of date: run python -m tools.generate_docs", file=sys.stderr)
        else:
            path.write_text(text, encoding="utf-8")
            print(name)
    return int(args.check and bool(stale))


if __name__ == "__main__":
    sys.exit(main())
