"""
The node's parameters as ROS 2 describes them, and as its help lists them.
"""

from __future__ import annotations

from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor

from hybrid_ins import parameters
from hybrid_ins.errors import InputError
from hybrid_ins.parameters.parameter import Parameter

LARGEST_BOUND = 1e300  # beyond it a range is none


def descriptor(parameter: Parameter, fixed: bool = True) -> ParameterDescriptor:
    """
    Return the descriptor of a parameter.

    One that takes effect when the node is configured is read-only where that is ``fixed``: where it
    happens at the start.
    """
    described = ParameterDescriptor(
        description=parameter.text + (f" [{parameter.unit}]" if parameter.unit else ""),
        additional_constraints=", ".join(parameter.choices) or parameter.bounds(),
        read_only=fixed and not parameter.runtime,
        dynamic_typing=True,
    )
    low = 0.0 if parameter.or_zero else parameter.low
    high, default = parameter.high, parameter.default
    if abs(low) >= LARGEST_BOUND or abs(high) >= LARGEST_BOUND:
        return described
    if isinstance(default, float):
        described.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    elif isinstance(default, int) and not isinstance(default, bool):
        described.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
    return described


def plain(value: Any) -> Any:
    """Return a parameter's value as rclpy's arrays and numbers are in YAML."""
    if value is None:  # what ROS makes of an empty list
        return []
    return list(value) if hasattr(value, "__len__") and not isinstance(value, str) else value


def read_texts(changes: list[Any]) -> list[Any]:
    """
    Return changed parameters with the numbers that ``ros2 param`` sends as texts.

    It sends 1e-6, and lists such as [0.1, 0, 0], as texts. What is not valid stays as it is, for
    the check to refuse.
    """
    return [_read_text(change) for change in changes]


def _read_text(change: Any) -> Any:
    parameter, value = parameters.PARAMETERS.get(change.name), plain(change.value)
    if parameter is None or isinstance(parameter.default, str):
        return change
    if not isinstance(value, str) and not (isinstance(value, list) and str in map(type, value)):
        return change
    try:
        return type(change)(change.name, value=parameter.check(value))
    except InputError:
        return change


def unknown(changes: list[Any]) -> str:
    """Return what is said of the first change whose name is no parameter; empty if all are."""
    for change in changes:
        try:
            parameters.find(change.name)
        except InputError as error:
            return str(error)
    return ""


def help_text() -> str:
    """Return what ``ins_node --help`` prints."""
    rows = []
    for p in parameters.PARAMETERS.values():
        unit = f" [{p.unit}]" if p.unit else ""
        words = f" ({', '.join(p.choices)})" if p.choices else ""
        rows.append(f"  {p.name} = {p.default}{unit}\n      {p.text}{words}")
    return (
        "usage: ins_node [--ros-args] [--params-file F] [-p NAME:=VALUE] [-r FROM:=TO]\n\n"
        "INS/GNSS navigation: imu/data and gnss/fix in, odometry out.\n\n"
        "example:\n  ins_node --params-file params.yaml -r imu/data:=/my_imu/data\n\n"
        "parameters and their defaults:\n" + "\n".join(rows)
    )
