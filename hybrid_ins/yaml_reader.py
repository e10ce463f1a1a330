"""Safe reader for user-supplied YAML: plain values only, from regular files of limited size."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from hybrid_ins.errors import InputError
from hybrid_ins.resources import read_regular_file

LARGEST_FILE = 100_000  # bytes


class _PlainLoader(yaml.SafeLoader):
    """YAML without tags, and without anchors: a file cannot grow by referring to itself."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.events.AliasEvent):
            raise yaml.YAMLError("aliases (*name) are not accepted")
        return super().compose_node(parent, index)


# YAML 1.1 reads 1e-4 as a text; ROS reads it as the number that everybody means.
_PlainLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?\d+(\.\d*)?[eE][-+]?\d+$"), list("-+0123456789")
)


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
        No such file, not a regular file, too large, or not YAML.
    """
    content = read_regular_file(path, LARGEST_FILE, what)
    try:
        return parse(content.decode("utf-8"))
    except ValueError as error:  # UnicodeDecodeError is one
        raise InputError(f"{path}: no readable YAML: {error}") from None
