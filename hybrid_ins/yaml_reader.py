"""Safe reader for user-supplied YAML: plain values only, from regular files of limited size."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from hybrid_ins.errors import InputError
from hybrid_ins.resources import read_regular_file, shortened

LARGEST_FILE = 100_000  # bytes


PARAMETERS = "ros__parameters"


class GivenTwice(ValueError):
    """A key is given twice, of which YAML would keep the last; the text names it and the line."""


class _PlainLoader(yaml.SafeLoader):
    """
    YAML without tags, and without anchors: a file cannot grow by referring to itself.

    Every key is given once, also where ``a.b: 1`` and ``a: {b: 1}`` are the same to ROS.
    """

    def get_single_node(self) -> Any:
        node = super().get_single_node()
        _check_keys(node, "", set())
        return node

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.events.AliasEvent):
            raise yaml.YAMLError("aliases (*name) are not accepted")
        return super().compose_node(parent, index)


# YAML 1.1 reads 1e-4 and -.4 as texts; ROS reads them as the numbers that everybody means.
_PlainLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"([-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+|[-+]\.\d+)$"),
    list("-+.0123456789"),
)


def _check_keys(node: Any, prefix: str, leaves: set[str]) -> None:
    """Raise `GivenTwice` where a key occurs again in a mapping, or a leaf by its dotted name."""
    if isinstance(node, yaml.SequenceNode):
        for item in node.value:
            _check_keys(item, "", set())
    if not isinstance(node, yaml.MappingNode):
        return
    keys: set[str] = set()
    for key, value in node.value:
        name = prefix + str(key.value)
        is_leaf = not isinstance(value, yaml.MappingNode)
        if name in keys or (is_leaf and name in leaves):
            shown = name.rpartition(f"{PARAMETERS}.")[2]
            raise GivenTwice(f"{shortened(shown)} is given twice, line {key.start_mark.line + 1}")
        keys.add(name)
        if is_leaf:
            leaves.add(name)
        _check_keys(value, f"{name}.", leaves)


def parse(text: str) -> object:
    """
    Return what a text of YAML says.

    Raises
    ------
    ValueError
        The text is not plain YAML; the error's text says why, and in which line.
    """
    try:
        return yaml.load(text, _PlainLoader)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f"line {mark.line + 1}: " if mark else ""
        raise ValueError(f"{where}{error.problem or error.context}") from None
    except yaml.YAMLError as error:
        raise ValueError(" ".join(str(error).split())[:200]) from None


def read(path: Path, what: str) -> object:
    """
    Return what a file of YAML says.

    ``what`` it should be is named in the error, for example "a parameter file".

    Raises
    ------
    InputError
        No such file, not a regular file, too large, not YAML, or a key is given twice.
    """
    content = read_regular_file(path, LARGEST_FILE, what)
    try:
        return parse(content.decode("utf-8"))
    except GivenTwice as error:
        raise InputError(f"{path}: {error}: keep one of them") from None
    except ValueError as error:  # UnicodeDecodeError is one
        raise InputError(f"{path}: no readable YAML: {error}") from None


def check_lists(content: object, path: Path, prefix: str = "") -> None:
    """
    Refuse what the parser of ROS refuses without a name: lists that mix texts, numbers and truth.

    Raises
    ------
    InputError
        Names the key.
    """
    if isinstance(content, dict):
        for key, value in content.items():
            check_lists(value, path, f"{prefix}{key}.")
    if not isinstance(content, list):
        return
    kinds = {float if type(value) is int else type(value) for value in content}
    if len(kinds) > 1 and kinds <= {float, bool, str}:
        name = prefix.rstrip(".").rpartition(f"{PARAMETERS}.")[2]
        what, remedy = "numbers and true or false", "write values of one kind"
        if str in kinds:
            what, remedy = "numbers and texts", "write numbers only, without quotes"
        shown = shortened(repr(content), 60)
        raise InputError(f"{path}: {name}: {shown} mixes {what}, which ROS refuses: {remedy}")
