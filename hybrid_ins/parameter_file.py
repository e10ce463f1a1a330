"""YAML files from strangers: plain values only, of a size that a file for people has."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from hybrid_ins.errors import InputError

LARGEST_FILE = 100_000  # bytes


class _PlainLoader(yaml.SafeLoader):
    """YAML without tags, and without anchors: a file cannot grow by referring to itself."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.events.AliasEvent):
            raise yaml.YAMLError("aliases (*name) are not accepted")
        return super().compose_node(parent, index)


# YAML 1.1 takes 1e-4 for a text; ROS takes it for the number that everybody means.
_PlainLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?\d+(\.\d*)?[eE][-+]?\d+$"), list("-+0123456789")
)


def parse(text: str) -> object:
    """Return what a text of YAML says, or raise `yaml.YAMLError` or `ValueError`."""
    return yaml.load(text, _PlainLoader)


def read(path: Path, what: str) -> object:
    """
    Return what a file says.

    ``what`` it should be is named in the error, for example "a parameter file".

    Raises
    ------
    InputError
        No such file, too large, or not YAML.
    """
    try:
        if path.stat().st_size > LARGEST_FILE:
            raise InputError(f"{path}: larger than {LARGEST_FILE} bytes: that is not {what}")
        return parse(path.read_text(encoding="utf-8"))
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}: give {what}") from None
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: no readable YAML: {reason[:200]}") from None
