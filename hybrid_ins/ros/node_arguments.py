"""
The node's command line as ROS reads it: parameter files and values that ROS would not accept.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import yaml

from hybrid_ins import yaml_reader
from hybrid_ins.errors import InputError
from hybrid_ins.resources import shortened

ROS = "--ros-args"
SOURCE = re.compile(r",? at /\S+:\d+")  # what rcl adds: where in its C source
CAUSE = ". Error: "  # what rcl puts before it
LOG_FOLDER = re.compile("(logging|log) directory")
FILE, VALUE = ("--params-file",), ("-p", "--param")


@contextmanager
def for_ros(words: Sequence[str]) -> Iterator[list[str]]:
    """
    Give arguments for ``rclpy.init``, which the block is to call.

    All arguments are taken for those of ROS, with ``--ros-args`` or without. In parameter files and
    values, lists such as [0.1, 0, 0] become lists of numbers of one type, which ROS wants.

    Raises
    ------
    InputError
        A parameter file cannot be read, a list in it mixes texts and numbers, or an option lacks
        its value.
    """
    with TemporaryDirectory(prefix="ins_node") as folder:
        changed = list(words)
        for k, word in enumerate(words):
            if word not in FILE + VALUE:
                continue
            if k + 1 == len(words):
                raise InputError(f"{word}: nothing follows; see ins_node --help")
            if word in FILE:
                changed[k + 1] = _file(words[k + 1], Path(folder, f"{k}.yaml"))
            else:
                changed[k + 1] = _value(words[k + 1])
        yield [] if not words else [*([] if words[0] == ROS else [ROS]), *changed]


def _file(path: str, copy: Path) -> str:
    """Return the path of a parameter file, or of a copy where lists in it mix types."""
    content = yaml_reader.read(Path(path), "a parameter file")
    yaml_reader.check_lists(content, Path(path))
    same = of_one_type(content)
    if repr(same) == repr(content):
        return path
    copy.write_text(yaml.safe_dump(same, allow_unicode=True), encoding="utf-8")
    return str(copy)


def unused_files(words: Sequence[str], node: str) -> Iterator[str]:
    """Yield what is wrong with parameter files without a section for a node, by its full name."""
    for option, path in pairwise(words):
        if option not in FILE:
            continue
        names = list(_sections(yaml_reader.read(Path(path), "a parameter file")))
        if names and not any(_pattern(name).fullmatch(node) for name in names):
            yield (
                f"{path}: no section for {node}, only for {', '.join(names)}: nothing in it is "
                f"used; write '/**:' or '{node}:'"
            )


def _sections(content: Any, prefix: str = "") -> Iterator[str]:
    """Yield the names of the nodes that a parameter file is for."""
    for name, body in content.items() if isinstance(content, dict) else ():
        if name == yaml_reader.PARAMETERS:
            yield prefix
        else:
            yield from _sections(body, f"{prefix}/{str(name).strip('/')}")


def _pattern(name: str) -> re.Pattern[str]:
    """Return what a section's name stands for: * is one part of a node's name, ** are any."""
    parts = {"*": r"/[^/]+", "**": r"(/[^/]+)*"}
    return re.compile("".join(parts.get(p, "/" + re.escape(p)) for p in name.split("/")[1:]))


def _value(text: str) -> str:
    name, separator, value = text.partition(":=")
    try:
        read = yaml_reader.parse(value)
    except ValueError:  # ROS says what is wrong
        return text
    yaml_reader.check_lists({name: read}, Path("-p"))
    same = of_one_type(read)
    return text if repr(same) == repr(read) else f"{name}{separator}{same}"


def reason_of(error: Exception) -> str:
    """Return what ROS says in one line, without places in its C source."""
    what, _, cause = SOURCE.split(str(error))[0].partition(CAUSE)
    if "params file" in what:  # of a remapping, it is about lexemes
        what = f"{what}: {cause}"
    reason = shortened(" ".join(what.split()), 400)
    if LOG_FOLDER.search(reason):
        return f"{reason}: set HOME, or ROS_LOG_DIR to a folder that can be written"
    return reason


def of_one_type(content: Any) -> Any:
    """Return what a YAML file holds with floating-point numbers only in lists that mix numbers."""
    if isinstance(content, dict):
        return {key: of_one_type(value) for key, value in content.items()}
    if not isinstance(content, list):
        return content
    kinds = {type(value) for value in content}
    return [float(value) for value in content] if kinds == {int, float} else content
