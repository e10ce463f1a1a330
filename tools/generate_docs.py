"""
Write the parts of the documentation that are made from declarations and reports, or check them.

`config/default.yaml` and `docs/parameters.md` are made from `hybrid_ins.parameters`;
`docs/figures.md` and the figures in `README.md` from the reports that `tools.figures` names. A test
runs the check.
"""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from hybrid_ins.parameters import PARAMETERS, Parameter  # noqa: E402
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
    "noise": "Process noise",
}
PREAMBLE = """\
# Parameters

Every parameter of `ins_node`, and of `ins_replay`, which reads the same file. This page and
[config/default.yaml](../config/default.yaml) are written by `python -m tools.generate_docs`.

    ros2 run hybrid_ins ins_node --ros-args --params-file my_robot.yaml
    ros2 param describe /ins_node gnss.patience
    ros2 param set /ins_node noise.mode constant

**live** means that `ros2 param set` takes effect at once and keeps the state; the others take
effect at the start. A wrong value is refused in one line, by the node, by `ros2 param set` and by
the programs alike; so is a name that does not exist, only that the node warns of it and goes on:
the section `/**` of a file may be meant for other nodes, too.
"""


def row(parameter: Parameter) -> str:
    """Return a parameter's row of the Markdown table."""
    kind = "live" if parameter.runtime else ""
    words = ", ".join(f"`{word}`" for word in parameter.choices)
    text = parameter.text + (f" ({words})" if words else "")
    cells = (f"`{parameter.name}`", f"`{value(parameter.default)}`", span(parameter), kind, text)
    return "| " + " | ".join(cells) + " |"


def value(default: object) -> str:
    """Return a default as one writes it in YAML."""
    if isinstance(default, bool):
        return str(default).lower()
    if isinstance(default, list):
        return "[" + ", ".join(f"{v:g}" for v in default) + "]"
    return f"{default:g}" if isinstance(default, float) else str(default)


def span(parameter: Parameter) -> str:
    """Return the unit and the bounds."""
    bounds = ""
    if math.isfinite(parameter.low) and math.isfinite(parameter.high):
        bounds = f"{parameter.low:g} … {parameter.high:g}"
    return f"{bounds} {parameter.unit}".strip()


def table(names: Sequence[str]) -> str:
    """Return the table of some parameters."""
    head = "| parameter | default | range | | meaning |\n|---|---|---|---|---|\n"
    return head + "\n".join(row(PARAMETERS[name]) for name in names) + "\n"


def page() -> str:
    """Return `docs/parameters.md`."""
    parts = [PREAMBLE, f"## The ones to set first\n\n{table(FIRST_TO_SET)}"]
    names: dict[str, list[str]] = {group: [] for group in GROUPS}
    for name in PARAMETERS:
        names.setdefault(name.partition(".")[0] if "." in name else "", []).append(name)
    for group, members in names.items():
        parts.append(f"## {GROUPS.get(group, group)}\n\n{table(members)}")
    return "\n".join(parts)


def default_file() -> str:
    """Return `config/default.yaml`, as the module of the parameters prints it."""
    command = [sys.executable, "-m", "hybrid_ins.parameters"]
    return subprocess.run(
        command, cwd=ROOT, check=True, stdout=subprocess.PIPE, encoding="utf-8"
    ).stdout


def files() -> dict[Path, str]:
    """Return each generated file with what it must hold."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    readme = put_between("figures", figures.short_table(), readme)
    return {
        ROOT / "config/default.yaml": default_file(),
        ROOT / "docs/parameters.md": page(),
        ROOT / "docs/figures.md": figures.page(),
        ROOT / "README.md": readme,
    }


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
