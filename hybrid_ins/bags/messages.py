"""Message objects of the standard ROS 2 types, without ROS."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import Any, TypeAlias

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from hybrid_ins.ros.messages import gps_fix, interface

Message: TypeAlias = Any  # its class depends on the topic

TYPES = get_typestore(Stores.ROS2_JAZZY)
for _name, _text in gps_fix.DEFINITIONS.items():
    TYPES.register(get_types_from_msg(_text, _name))


def is_standard(type_name: str) -> bool:
    """Return whether bags can hold a type here: those that come with ROS 2, and a GPSFix."""
    return type_name in TYPES.fielddefs


def new_message(type_name: str) -> Message:
    """
    Make a message of a standard ROS 2 type, such as ``"nav_msgs/msg/Odometry"``.

    Numbers are 0, texts empty, fixed-size arrays NumPy zeros, sequences empty; nested messages are
    there and every attribute can be set.
    """
    make, fields = _fields_of(type_name)
    return make(*[zero() for zero in fields])


@cache
def _fields_of(type_name: str) -> tuple[Callable[..., Message], list[Callable[[], Any]]]:
    """Return the class of a type, and for each of its fields what makes its initial value."""
    fields = TYPES.fielddefs[type_name][1]
    return TYPES.types[type_name], [_zero_of(description) for _, description in fields]


def _zero_of(description: Any) -> Callable[[], Any]:
    kind, detail = description
    if kind == Nodetype.BASE:
        zero = {"string": "", "bool": False, "float32": 0.0, "float64": 0.0}.get(detail[0], 0)
        return lambda: zero
    if kind == Nodetype.NAME:
        return partial(new_message, detail)
    element, length = detail
    length = 0 if kind == Nodetype.SEQUENCE else length
    if element[0] == Nodetype.BASE and element[1][0] != "string":
        name = element[1][0]
        return partial(np.zeros, length, "uint8" if name in ("byte", "char") else name)
    make = _zero_of(element)
    return lambda: [make() for _ in range(length)]


def absolute(topic: str) -> str:
    """Return a topic's name with its leading slash."""
    return topic if topic.startswith("/") else f"/{topic}"


TRUTH = "/truth/"  # topics of the true motion begin with it
LATCHED = frozenset(
    {"/truth/datum"}
    | {absolute(name) for name, q in interface.QUALITY.items() if q.transient_local}
)
"""Topics whose last message late readers get."""
