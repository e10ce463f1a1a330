"""
Every parameter of the package, declared once.

The node declares these to ROS, ``ins_replay`` reads the same file without ROS, ``ins_calibrate``
writes it, and the documentation's table is printed from here.
"""

from __future__ import annotations

import difflib
import math
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from hybrid_ins import parameter_file
from hybrid_ins.errors import InputError

Value = bool | int | float | str | list[float]
Values = dict[str, Value]

NODE_NAME = "ins_node"


@dataclass(frozen=True, slots=True)
class Parameter:
    """
    One parameter: its default fixes its type.

    Attributes
    ----------
    name, default, text : str, Value, str
        ``text`` says what it is, in words for ``ros2 param describe``.
    unit : str
        Empty for plain numbers and words.
    low, high : float
        Inclusive bounds of a number, or of each element of a list.
    choices : tuple of str
        Allowed words; empty: any.
    lengths : tuple of int
        Allowed lengths of a list; where 1 is, a number will do.
    runtime : bool
        It may be changed while the node runs.
    """

    name: str
    default: Value
    text: str
    unit: str = ""
    low: float = -math.inf
    high: float = math.inf
    choices: tuple[str, ...] = ()
    lengths: tuple[int, ...] = (3,)
    runtime: bool = False

    def check(self, value: object) -> Value:
        """
        Return ``value`` as this parameter's type.

        Raises
        ------
        InputError
            It has another type, or lies outside the bounds; the text names all three.
        """
        if isinstance(self.default, bool):
            if isinstance(value, bool):
                return value
            raise self._refusal(value, "true or false")
        if isinstance(self.default, str):
            if isinstance(value, str) and (not self.choices or value in self.choices):
                return value
            raise self._refusal(
                value, "one of " + ", ".join(self.choices) if self.choices else "a text"
            )
        if isinstance(self.default, list):
            if 1 in self.lengths and isinstance(value, int | float):
                value = [value]
            if not isinstance(value, list | tuple) or len(value) not in self.lengths:
                sizes = " or ".join(map(str, self.lengths))
                raise self._refusal(value, f"a list of {sizes} numbers")
            return [self._number(v) for v in value]
        if isinstance(self.default, int):
            if isinstance(value, bool) or not isinstance(value, int):
                raise self._refusal(value, "a whole number")
            return int(self._number(value))
        return self._number(value)

    def _number(self, value: object) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self._refusal(value, "a number")
        if not (math.isfinite(value) and self.low <= value <= self.high):
            raise self._refusal(
                value,
                f"between {self.low:g} and {self.high:g}" + (f" {self.unit}" if self.unit else ""),
            )
        return float(value)

    def _refusal(self, value: object, wanted: str) -> InputError:
        shown = repr(value)
        if len(shown) > 60:
            shown = shown[:57] + "..."
        return InputError(f"parameter {self.name}: {shown} is not {wanted} ({self.text})")


_METRES: dict[str, Any] = {"unit": "m", "low": -1000.0, "high": 1000.0}

PARAMETERS: dict[str, Parameter] = {
    p.name: p
    for p in (
        Parameter("map_frame", "map", "Frame of odometry: ENU at the datum (REP-105)"),
        Parameter("odom_frame", "odom", "Frame of odometry/local, without jumps (REP-105)"),
        Parameter("base_frame", "base_link", "Frame whose pose and twist are published"),
        Parameter(
            "datum",
            [],
            "Origin of the map as latitude [deg], longitude [deg], ellipsoidal "
            "height [m]; empty: the first good fix",
            lengths=(0, 3),
            low=-12000.0,
            high=1e7,
        ),
        Parameter(
            "use_receive_time",
            False,
            "Take the time of arrival for the stamp of every message: "
            "only for drivers that do not stamp, it costs accuracy",
        ),
        Parameter(
            "use_tf_static",
            True,
            "Where imu.position and imu.mount_rpy, or "
            "gnss.antenna_position, are all zero: take them from /tf_static by frame_id",
        ),
        Parameter(
            "imu.position", [0.0, 0.0, 0.0], "IMU in base_frame (forward, left, up)", **_METRES
        ),
        Parameter(
            "imu.mount_rpy",
            [0.0, 0.0, 0.0],
            "Roll, pitch, yaw that turn base_frame's axes into the IMU's",
            unit="rad",
            low=-6.3,
            high=6.3,
        ),
        Parameter(
            "imu.accelerometer_bias",
            [0.0, 0.0, 0.0],
            "Accelerometer bias at start (forward, left, up), as imu/bias tells it",
            unit="m/s²",
            low=-10.0,
            high=10.0,
        ),
        Parameter(
            "imu.accelerometer_bias_std",
            [0.3],
            "Uncertainty of the accelerometer bias at "
            "start: of all axes, or of each (forward, left, up)",
            unit="m/s²",
            lengths=(1, 3),
            low=1e-6,
            high=10.0,
        ),
        Parameter(
            "imu.gyroscope_bias",
            [0.0, 0.0, 0.0],
            "Gyroscope bias at start (forward, left, up), as imu/bias tells it",
            unit="rad/s",
            low=-1.0,
            high=1.0,
        ),
        Parameter(
            "imu.gyroscope_bias_std",
            [0.01],
            "Uncertainty of the gyroscope bias at start: of "
            "all axes, or of each (forward, left, up)",
            unit="rad/s",
            lengths=(1, 3),
            low=1e-8,
            high=1.0,
        ),
        Parameter(
            "imu.accelerometer_bias_walk",
            1e-3,
            "Random walk of the accelerometer bias",
            unit="m/s²/√s",
            low=0.0,
            high=10.0,
            runtime=True,
        ),
        Parameter(
            "imu.gyroscope_bias_walk",
            1e-4,
            "Random walk of the gyroscope bias",
            unit="rad/s/√s",
            low=0.0,
            high=1.0,
            runtime=True,
        ),
        Parameter(
            "imu.max_specific_force",
            400.0,
            "Readings beyond this are refused as faulty",
            unit="m/s²",
            low=20.0,
            high=1e5,
        ),
        Parameter(
            "imu.max_angular_rate",
            80.0,
            "Readings beyond this are refused as faulty or given in degrees",
            unit="rad/s",
            low=1.0,
            high=1e4,
        ),
        Parameter(
            "imu.zero_updates",
            True,
            "Tell the filter that it does not move while the IMU and "
            "the filter's own speed say that the vehicle stands",
        ),
        Parameter(
            "imu.max_gap",
            0.5,
            "A longer gap between IMU samples ends dead reckoning: the filter aligns anew",
            unit="s",
            low=0.01,
            high=60.0,
        ),
        Parameter(
            "gnss.antenna_position",
            [0.0, 0.0, 0.0],
            "Antenna in base_frame (forward, left, up)",
            **_METRES,
        ),
        Parameter(
            "gnss.position_std_default",
            [3.0, 3.0, 6.0],
            "Standard deviations, east north up, used where a fix carries no usable covariance",
            unit="m",
            low=1e-3,
            high=1000.0,
        ),
        Parameter(
            "gnss.position_std_min",
            0.01,
            "Floor of a fix's standard deviations: receivers "
            "claim millimetres that clock and lever arm do not keep",
            unit="m",
            low=0.0,
            high=100.0,
            runtime=True,
        ),
        Parameter(
            "gnss.position_std_max",
            100.0,
            "Fixes with a greater horizontal standard deviation are refused",
            unit="m",
            low=0.01,
            high=1e5,
            runtime=True,
        ),
        Parameter(
            "gnss.velocity_std_default",
            0.2,
            "Standard deviation used where a velocity carries no usable covariance",
            unit="m/s",
            low=1e-3,
            high=100.0,
        ),
        Parameter(
            "gnss.velocity_std_min",
            0.02,
            "Floor of a velocity's standard deviations",
            unit="m/s",
            low=0.0,
            high=100.0,
            runtime=True,
        ),
        Parameter(
            "gnss.gate_probability",
            0.9999,
            "Share of sound fixes that the chi-square gate lets pass",
            low=0.5,
            high=1.0 - 1e-12,
            runtime=True,
        ),
        Parameter(
            "gnss.patience",
            3.0,
            "Fixes refused without interruption for this long are taken "
            "for right and the state for wrong",
            unit="s",
            low=0.0,
            high=3600.0,
            runtime=True,
        ),
        Parameter(
            "gnss.max_delay",
            1.0,
            "Fixes that arrive later than this after their stamp are "
            "refused; younger ones are fused where they belong",
            unit="s",
            low=0.0,
            high=5.0,
        ),
        Parameter(
            "gnss.time_offset.value",
            0.0,
            "Added to the stamps of fixes to bring them to the IMU's clock",
            unit="s",
            low=-10.0,
            high=10.0,
            runtime=True,
        ),
        Parameter(
            "gnss.time_offset.estimate",
            False,
            "Find the clock offset while running and "
            "correct it; otherwise a wrong one is only told",
            runtime=True,
        ),
        Parameter(
            "alignment.heading_source",
            "auto",
            "Where the first heading comes from",
            choices=("auto", "motion", "parameter", "imu", "course"),
        ),
        Parameter(
            "alignment.yaw",
            0.0,
            "Heading at start for heading_source parameter: of base_frame "
            "in map, 0 east, counter-clockwise",
            unit="rad",
            low=-6.3,
            high=6.3,
        ),
        Parameter(
            "alignment.yaw_std",
            0.1,
            "Uncertainty of the heading given by parameter or IMU",
            unit="rad",
            low=1e-4,
            high=3.2,
        ),
        Parameter(
            "alignment.course_min_speed",
            1.0,
            "Speed from which the course over ground is taken for the heading",
            unit="m/s",
            low=0.1,
            high=50.0,
        ),
        Parameter(
            "alignment.window",
            1.0,
            "IMU time that levelling averages",
            unit="s",
            low=0.05,
            high=5.0,
        ),
        Parameter(
            "noise.mode",
            "learned",
            "Where the process noise comes from: a regressor on the "
            "IMU's last samples, a constant (ours or the paper's three), or the innovations",
            choices=(
                "learned",
                "constant",
                "cq1",
                "cq2",
                "cq3",
                "innovation",
                "innovation_literal",
            ),
            runtime=True,
        ),
        Parameter(
            "noise.model",
            "plateau",
            "Regressor of mode learned: a model that comes with the "
            "package (plateau, paper), spectral, or the path of an .onnx file",
            runtime=True,
        ),
        Parameter(
            "noise.refresh_period",
            0.2,
            "The regressor runs once per this time",
            unit="s",
            low=0.01,
            high=10.0,
            runtime=True,
        ),
        Parameter(
            "noise.innovation_scale",
            True,
            "In mode learned: multiply the noise, and what fixes "
            "claim, by factors, up when the innovations show that the IMU or the fixes are worse "
            "than their noise, and down by thirty at most",
            runtime=True,
        ),
        Parameter(
            "noise.innovation_window",
            3,
            "Innovations averaged in mode innovation, the paper's ξ",
            low=1,
            high=100,
            runtime=True,
        ),
        Parameter(
            "noise.units",
            "consistent",
            "consistent: Qc = q·Δt; paper: Qc = q, literally",
            choices=("consistent", "paper"),
            runtime=True,
        ),
        Parameter(
            "noise.q_accelerometer",
            4e-4,
            "Per-sample variance of the accelerometer: the "
            "constant, and what learned modes fall back to",
            unit="(m/s²)²",
            low=1e-12,
            high=1e4,
            runtime=True,
        ),
        Parameter(
            "noise.background_accelerometer",
            [0.0, 0.0, 0.0],
            "Level that the regressor hardly "
            "ever exceeds in this vehicle's ordinary motion (forward, left, up), where "
            "noise.q_accelerometer is the noise: only levels above it count as more; 0: not "
            "known, all levels count",
            unit="(m/s²)²",
            low=0.0,
            high=1e4,
            runtime=True,
        ),
        Parameter(
            "noise.q_accelerometer_min",
            1e-8,
            "Lowest level that is believed",
            unit="(m/s²)²",
            low=0.0,
            high=1e4,
            runtime=True,
        ),
        Parameter(
            "noise.q_accelerometer_max",
            1e3,
            "Estimates beyond this are refused",
            unit="(m/s²)²",
            low=1e-12,
            high=1e6,
            runtime=True,
        ),
        Parameter(
            "noise.q_gyroscope",
            4e-6,
            "Per-sample variance of the gyroscope: the constant, and "
            "what learned modes fall back to",
            unit="(rad/s)²",
            low=1e-14,
            high=1e2,
            runtime=True,
        ),
        Parameter(
            "noise.background_gyroscope",
            [0.0, 0.0, 0.0],
            "The same of the gyroscope, beside noise.q_gyroscope",
            unit="(rad/s)²",
            low=0.0,
            high=1e2,
            runtime=True,
        ),
        Parameter(
            "noise.q_gyroscope_min",
            1e-10,
            "Lowest level that is believed",
            unit="(rad/s)²",
            low=0.0,
            high=1e2,
            runtime=True,
        ),
        Parameter(
            "noise.q_gyroscope_max",
            10.0,
            "Estimates beyond this are refused",
            unit="(rad/s)²",
            low=1e-14,
            high=1e4,
            runtime=True,
        ),
        Parameter(
            "covariance_interval",
            0.01,
            "The covariance is propagated once per this time, and "
            "before every update; 0: with every IMU sample",
            unit="s",
            low=0.0,
            high=0.05,
        ),
        Parameter(
            "odometry_rate",
            0.0,
            "Rate of odometry; 0: with every IMU sample",
            unit="Hz",
            low=0.0,
            high=10000.0,
            runtime=True,
        ),
        Parameter("publish_tf", True, "Publish map→odom→base_frame where tf2 is installed"),
    )
}


def defaults() -> Values:
    """Return every parameter's default."""
    return {name: p.default for name, p in PARAMETERS.items()}


def check_all(given: Mapping[str, object]) -> Values:
    """
    Return the defaults overlaid with ``given``, every value checked.

    Raises
    ------
    InputError
        Unknown name (the nearest known one is suggested) or impossible value.
    """
    values = defaults()
    for name, value in given.items():
        if name in ("use_sim_time",) or name.startswith("qos_overrides."):
            continue
        values[name] = find(name).check(value)
    check_together(values)
    return values


def find(name: str) -> Parameter:
    """Return a parameter by name, or raise `InputError` with the nearest known name."""
    try:
        return PARAMETERS[name]
    except KeyError:
        near = difflib.get_close_matches(name, PARAMETERS, 1, 0.5)
        hint = f"did you mean {near[0]}?" if near else "see the README's table of parameters"
        raise InputError(f"parameter {name}: unknown; {hint}") from None


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
                "parameter file and start anew"
            )
    check_together({**values, **checked})
    return checked


def parse_value(name: str, text: str) -> object:
    """Return a value given on a command line, or raise `InputError`."""
    find(name)
    try:
        return parameter_file.parse(text)
    except (yaml.YAMLError, ValueError):
        raise InputError(f"parameter {name}: {text!r} is no value") from None


def check_together(values: Mapping[str, Any]) -> None:
    """Raise `InputError` where values contradict each other."""
    datum = values["datum"]
    if datum and not (abs(datum[0]) < 90.0 and abs(datum[1]) <= 360.0):
        raise InputError(
            f"parameter datum: {datum} is no latitude [deg], longitude [deg], height [m]"
        )
    if values["gnss.position_std_min"] > values["gnss.position_std_max"]:
        raise InputError(
            "parameter gnss.position_std_min: "
            f"{values['gnss.position_std_min']:g} m exceeds gnss.position_std_max"
        )


def load_file(path: str | Path) -> Values:
    """
    Read a ROS 2 parameter file: ``<node name or /**>: {ros__parameters: {...}}``.

    Raises
    ------
    InputError
        No such file, too large, not YAML, not that form, or a value that `check_all` refuses.
    """
    path = Path(path)
    content = parameter_file.read(path, "a parameter file")
    return check_all(flatten(_ros_parameters(path, content), path))


def _ros_parameters(path: Path, content: object) -> dict[str, object]:
    """Merge the sections of a parameter file that concern the node."""
    if not isinstance(content, dict):
        raise InputError(
            f"{path}: no parameter file: it must start with '/**:' or "
            f"'{NODE_NAME}:' and hold 'ros__parameters:'"
        )
    merged: dict[str, object] = {}
    for section, body in content.items():
        if section != "/**" and str(section).rstrip("/").split("/")[-1] != NODE_NAME:
            continue
        if not isinstance(body, dict) or not isinstance(body.get("ros__parameters"), dict):
            raise InputError(f"{path}: section '{section}' holds no 'ros__parameters:'")
        merged.update(body["ros__parameters"])
    if not merged and content:
        raise InputError(f"{path}: no section for {NODE_NAME}: use '/**:' or '{NODE_NAME}:'")
    return merged


def to_yaml(
    values: Mapping[str, Value], heading: str, notes: Mapping[str, str] | None = None
) -> str:
    """
    Return a parameter file with every one of ``values`` and its meaning.

    ``heading`` is the comment at the top, ``notes`` are further comments on some of the values.
    `load_file` reads the result back.
    """
    lines = [f"# {line}".rstrip() for line in heading.splitlines()]
    lines += ["/**:", "  ros__parameters:"]
    group: list[str] = []
    for name, parameter in PARAMETERS.items():
        if name not in values:
            continue
        *path, last = name.split(".")
        for depth, part in enumerate(path):
            if path[: depth + 1] != group[: depth + 1]:
                lines += [""] if depth == 0 and not lines[-1].endswith("parameters:") else []
                lines.append("    " + "  " * depth + f"{part}:")
        group = path
        indent = "    " + "  " * len(path)
        lines += textwrap.wrap(
            parameter.text + (f" [{parameter.unit}]" if parameter.unit else ""),
            initial_indent=indent + "# ",
            subsequent_indent=indent + "# ",
            width=98,
        )
        if parameter.choices:
            lines += textwrap.wrap(
                ", ".join(parameter.choices),
                initial_indent=indent + "# one of: ",
                subsequent_indent=indent + "#         ",
                width=98,
            )
        if notes and name in notes:
            lines += textwrap.wrap(
                notes[name], initial_indent=indent + "# ", subsequent_indent=indent + "# ", width=98
            )
        lines.append(f"{indent}{last}: {_scalar(values[name])}")
    return "\n".join(lines) + "\n"


def _scalar(value: Value) -> str:
    """Return a value as YAML text that reads back as the same type."""
    if isinstance(value, list):
        return "[" + ", ".join(map(_scalar, value)) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        # YAML 1.1 takes 1e-05 for a text.
        mantissa, _, exponent = repr(value).partition("e")
        if exponent and "." not in mantissa:
            mantissa += ".0"
        return f"{mantissa}e{exponent}" if exponent else mantissa
    return f'"{value}"' if isinstance(value, str) and not value.isidentifier() else str(value)


def flatten(tree: Mapping[Any, object], path: Path, prefix: str = "") -> dict[str, object]:
    """Return nested parameters under their dotted names."""
    flat: dict[str, object] = {}
    for key, value in tree.items():
        if not isinstance(key, str):
            raise InputError(f"{path}: {prefix}{key}: a parameter's name must be a text")
        if isinstance(value, dict):
            flat.update(flatten(value, path, f"{prefix}{key}."))
        else:
            flat[prefix + key] = value
    return flat


if __name__ == "__main__":
    print(
        to_yaml(
            defaults(),
            "Every parameter of ins_node with its default.\n\n"
            "Copy this file, keep what differs, and start the node with\n"
            "  ros2 run hybrid_ins ins_node --ros-args --params-file my_robot.yaml\n"
            "Written by: python3 -m hybrid_ins.parameters > config/default.yaml",
        ),
        end="",
    )
