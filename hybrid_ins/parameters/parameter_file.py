"""ROS 2 parameter files: read into checked values, and written with descriptions."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hybrid_ins import parameters, yaml_reader
from hybrid_ins.errors import InputError
from hybrid_ins.parameters.parameter import Parameter, Value

WIDTH = 98


def load(path: str | Path) -> parameters.Values:
    """
    Read a ROS 2 parameter file: ``<node name or /**>: {ros__parameters: {...}}``.

    Raises
    ------
    InputError
        No such file, too large, not YAML, not that form, or a value that `parameters.check_all`
        refuses.
    """
    path = Path(path)
    content = yaml_reader.read(path, "a parameter file")
    yaml_reader.check_lists(content, path)
    return parameters.check_all(_ros_parameters(path, content))


def check_replaceable(path: Path) -> None:
    """Raise `InputError` where there is a file that is no parameter file, of whichever node."""
    if not path.is_file() or path.stat().st_size == 0:
        return
    try:
        content = yaml_reader.read(path, "a parameter file")
    except InputError:
        content = None
    sections = content.values() if isinstance(content, dict) else ()
    if not any(isinstance(body, dict) and "ros__parameters" in body for body in sections):
        raise InputError(
            f"{path}: is not a parameter file (no ros__parameters in it): not overwritten; choose "
            "another name"
        )


def _ros_parameters(path: Path, content: object) -> dict[str, object]:
    """Merge the sections of a parameter file that concern the node, under dotted names."""
    node = parameters.NODE_NAME
    if not isinstance(content, dict):
        raise InputError(
            f"{path}: not a parameter file: it must start with '/**:' or '{node}:' and hold "
            "'ros__parameters:'"
        )
    merged: dict[str, object] = {}
    found = False
    for section, body in content.items():
        if section != "/**" and str(section).rstrip("/").split("/")[-1] != node:
            continue
        if not isinstance(body, dict) or not isinstance(body.get("ros__parameters"), dict):
            raise InputError(
                f"{path}: section '{section}' holds no 'ros__parameters:' with parameters below it"
            )
        merged.update(_flatten(body["ros__parameters"], path))
        found = True
    if not found and content:
        raise InputError(f"{path}: no section for {node}: use '/**:' or '{node}:'")
    return merged


def _flatten(tree: Mapping[Any, object], path: Path, prefix: str = "") -> dict[str, object]:
    """Return nested parameters under their dotted names."""
    flat: dict[str, object] = {}
    for key, value in tree.items():
        if not isinstance(key, str):
            raise InputError(f"{path}: {prefix}{key}: a parameter's name must be a text")
        if isinstance(value, dict):
            flat.update(_flatten(value, path, f"{prefix}{key}."))
        else:
            flat[prefix + key] = value
    return flat


def to_yaml(
    values: Mapping[str, Value], heading: str, notes: Mapping[str, str] | None = None
) -> str:
    """
    Return a parameter file with every one of ``values`` and its description.

    ``heading`` is the comment at the top, ``notes`` are further comments on some of the values.
    `load` reads the result back.
    """
    lines = [f"# {line}".rstrip() for line in heading.splitlines()]
    lines += ["/**:", "  ros__parameters:"]
    group: list[str] = []
    for name, parameter in parameters.PARAMETERS.items():
        if name not in values:
            continue
        *path, last = name.split(".")
        for depth, part in enumerate(path):
            if path[: depth + 1] != group[: depth + 1]:
                lines += [""] if depth == 0 and not lines[-1].endswith("parameters:") else []
                lines.append("    " + "  " * depth + f"{part}:")
        group = path
        indent = "    " + "  " * len(path)
        for comment in _comments(parameter, (notes or {}).get(name, "")):
            lines += textwrap.wrap(
                comment,
                initial_indent=indent + "# ",
                subsequent_indent=indent + "# ",
                width=WIDTH,
            )
        lines.append(f"{indent}{last}: {_scalar(values[name])}")
    return "\n".join(lines) + "\n"


def _comments(parameter: Parameter, note: str) -> list[str]:
    unit = f" [{parameter.unit}]" if parameter.unit else ""
    comments = [("For experiments. " if parameter.experiment else "") + parameter.text + unit]
    if parameter.choices:
        usual = [c for c in parameter.choices if c not in parameter.experiment_choices]
        comments.append("One of: " + ", ".join(usual))
    if parameter.experiment_choices:
        comments.append("For experiments: " + ", ".join(parameter.experiment_choices))
    return [*comments, note] if note else comments


def _scalar(value: Value) -> str:
    """Return a value as YAML text that reads back as the same type."""
    if isinstance(value, list):
        return "[" + ", ".join(map(_scalar, value)) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        # YAML 1.1 reads 1e-05 as a text.
        mantissa, _, exponent = repr(value).partition("e")
        if exponent and "." not in mantissa:
            mantissa += ".0"
        return f"{mantissa}e{exponent}" if exponent else mantissa
    if isinstance(value, str):
        plain = value.isidentifier() and yaml_reader.parse(value) == value
        return value if plain else json.dumps(value, ensure_ascii=False)
    return str(value)
