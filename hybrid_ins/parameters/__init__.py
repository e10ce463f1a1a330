"""
The parameters as a set: defaults, checks, and suggestions for unknown names.

The node declares them to ROS, ``ins_replay`` reads the same file without ROS, ``ins_calibrate``
writes it. They are declared in `hybrid_ins.parameters.declared`.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from hybrid_ins import yaml_reader
from hybrid_ins.errors import InputError
from hybrid_ins.parameters.declared import PARAMETERS as PARAMETERS
from hybrid_ins.parameters.parameter import Parameter, Value
from hybrid_ins.resources import shortened

Values = dict[str, Value]

NODE_NAME = "ins_node"
SIMILAR = 0.7  # similarity of two names, by difflib, from which one is suggested for the other

LISTED = 4  # names of a group, at most
FAULTS = 4  # that are told at once, at most

OTHER_NAMES = {
    "imu_topic": "remap the topic imu/data (launch: imu_topic:=, programs: --imu-topic)",
    "fix_topic": "remap the topic gnss/fix (launch: fix_topic:=, programs: --fix-topic)",
    "velocity_topic": "remap the topic gnss/velocity (launch: velocity_topic:=)",
    "namespace": "start the node with -r __ns:=/NAME (launch: namespace:=)",
    "base_link_frame": "the parameter is base_frame",
    "frequency": "the parameter is odometry_rate",
    "publish_rate": "the parameter is odometry_rate",
}
"""What users set as parameters that are not, or have other names in other packages."""


def defaults() -> Values:
    """Return every parameter's default."""
    return {name: p.default for name, p in PARAMETERS.items()}


def check_all(given: Mapping[str, object]) -> Values:
    """
    Return the defaults overlaid with ``given``, every value checked.

    Raises
    ------
    InputError
        Unknown names (a similar known one is suggested) or impossible values.
    """
    values = defaults()
    faults: list[str] = []
    for name, value in given.items():
        if name == "use_sim_time" or name.startswith("qos_overrides."):
            continue
        try:
            values[name] = find(name).check(value)
        except InputError as error:
            faults.append(str(error))
    _refuse(faults)  # else it may be by these that values contradict each other
    check_together(values)
    return values


def _refuse(faults: Sequence[str]) -> None:
    """Raise `InputError` where there are faults, with the first of them."""
    if faults:
        more = f"; and {len(faults) - FAULTS} more" if len(faults) > FAULTS else ""
        raise InputError("; ".join(faults[:FAULTS]) + more)


def find(name: str) -> Parameter:
    """Return a parameter by name, or raise `InputError` with a suggestion."""
    try:
        return PARAMETERS[name]
    except KeyError:
        raise InputError(f"parameter {shortened(name)}: unknown; {_suggestion(name)}") from None


def _suggestion(name: str) -> str:
    if name in OTHER_NAMES:
        return OTHER_NAMES[name]
    parts = [known for known in PARAMETERS if known.startswith(f"{name}.")]
    if parts:
        return f"it is a group: did you mean {_listed(parts)}?"
    near = [known for known in PARAMETERS if known.endswith(f".{name}")]
    near += difflib.get_close_matches(name[:100], PARAMETERS, 1, SIMILAR)
    if near:
        return f"did you mean {near[0]}?"
    return "docs/parameters.md and ros2 param list show all names"


def _listed(names: list[str]) -> str:
    """Return the first names of a list for a text."""
    first = names[:LISTED]
    return f"{', '.join(first[:-1])} or {first[-1]}" if len(first) > 1 else first[0]


def check_change(values: Mapping[str, Value], changes: Mapping[str, object]) -> Values:
    """
    Return checked changes to a running estimator's ``values``.

    Raises
    ------
    InputError
        A value is impossible, or its parameter takes effect only at the start.
    """
    checked = {name: find(name).check(value) for name, value in changes.items()}
    for name, value in checked.items():
        if value != values[name] and not PARAMETERS[name].runtime:
            raise InputError(
                f"parameter {name}: takes effect only at the start: put it into the "
                "parameter file and restart the node"
            )
    check_together({**values, **checked})
    return checked


def parse_value(name: str, text: str) -> object:
    """Return a value given on a command line, or raise `InputError`."""
    find(name)
    try:
        return yaml_reader.parse(text)
    except ValueError as error:
        raise InputError(f"parameter {name}: {shortened(text)!r} is not YAML: {error}") from None


def check_together(values: Mapping[str, Any]) -> None:
    """Raise `InputError` where values contradict each other."""
    _refuse([*_contradictions(values), *_wrong_frames(values)])


def _contradictions(values: Mapping[str, Any]) -> Iterator[str]:
    datum = values["datum"]
    if datum and not (abs(datum[0]) < 90.0 and abs(datum[1]) <= 360.0):
        yield f"parameter datum: {datum} is not latitude [deg], longitude [deg], height [m]"
    for low in ("gnss.position_std_min", "noise.q_accelerometer_min", "noise.q_gyroscope_min"):
        high = low.replace("_min", "_max")
        if values[low] > values[high]:
            yield (
                f"parameter {low}: {values[low]:g} is greater than {high}, which is "
                f"{values[high]:g}: lower the one or raise the other"
            )


def _wrong_frames(values: Mapping[str, Any]) -> Iterator[str]:
    """Yield why frames would not make /tf a tree."""
    frames: dict[str, str] = {}
    for name in ("map_frame", "odom_frame", "base_frame"):
        frame = values[name]
        if not frame or frame.startswith("/") or any(c.isspace() for c in frame):
            yield (
                f"parameter {name}: {frame!r} is not a frame: give a name without spaces and "
                "without a leading slash"
            )
        elif frame in frames:
            yield (
                f"parameter {name}: '{frame}' is also {frames[frame]}: the transforms need "
                "three different frames"
            )
        frames[frame] = name
