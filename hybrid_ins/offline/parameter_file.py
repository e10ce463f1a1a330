"""A parameter file with a comment on every entry, for ``ins_node`` and ``ins_replay``."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from pathlib import Path

from hybrid_ins.errors import InputError
from hybrid_ins.parameters import PARAMETERS, Parameter, Value


def check(path: Path, overwrite: bool) -> None:
    """
    Find out before the work whether a file can be written to ``path``.

    Raises
    ------
    InputError
        It exists and may not be replaced, or there is no such folder.
    """
    if path.exists() and (path.is_dir() or not overwrite):
        raise InputError(f"{path}: exists: give --overwrite, or another name")
    if not path.parent.is_dir():
        raise InputError(f"{path}: no such folder")


def write(path: Path, values: Mapping[str, Value], notes: Mapping[str, str], title: str) -> None:
    """
    Write parameters in ROS 2's form.

    Parameters
    ----------
    path : Path
    values : mapping
        Value by parameter name; those that are not named are left to their defaults.
    notes : mapping
        A further comment on some of them.
    title : str
        First comment of the file.
    """
    path.write_text(text(values, notes, title), encoding="utf-8")


def text(values: Mapping[str, Value], notes: Mapping[str, str], title: str) -> str:
    """Return the file's content; see `write`."""
    lines = [*_comment(title, ""), "/**:", "  ros__parameters:"]
    open_groups: list[str] = []
    for name, parameter in _grouped(values):
        *groups, leaf = name.split(".")
        shared = 0
        while shared < min(len(groups), len(open_groups)) and (
                groups[shared] == open_groups[shared]):
            shared += 1
        for depth in range(shared, len(groups)):
            lines.append(f"{'  ' * (depth + 2)}{groups[depth]}:")
        open_groups = groups
        indent = "  " * (len(groups) + 2)
        unit = f" [{parameter.unit}]" if parameter.unit else ""
        lines += _comment(parameter.text + unit, indent)
        if name in notes:
            lines += _comment(notes[name], indent)
        lines.append(f"{indent}{leaf}: {_plain(values[name])}")
    return "\n".join(lines) + "\n"


def _grouped(values: Mapping[str, Value]) -> list[tuple[str, Parameter]]:
    """Parameters to write, those of one group together: a YAML key may stand only once."""
    order: dict[str, None] = {}
    for name in PARAMETERS:
        order.setdefault(name.split(".")[0])
    rank = {group: k for k, group in enumerate(order)}
    named = [(name, p) for name, p in PARAMETERS.items() if name in values]
    return sorted(named, key=lambda item: (rank[item[0].split(".")[0]], item[0].count(".")))


def _comment(words: str, indent: str) -> list[str]:
    return textwrap.wrap(words, 98, initial_indent=f"{indent}# ", subsequent_indent=f"{indent}# ")


def _plain(value: Value) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        shown = f"{value:.10g}"
        return shown if "." in shown or "inf" in shown else (
            shown.replace("e", ".0e") if "e" in shown else shown + ".0")
    if isinstance(value, list):
        return "[" + ", ".join(_plain(v) for v in value) + "]"
    return f'"{value}"' if isinstance(value, str) else str(value)
