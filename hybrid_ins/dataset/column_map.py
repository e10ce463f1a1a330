"""
Where a dataset's CSV files hold what: the YAML file behind ``ins_convert --map``, checked.

``config/datasets/quadrotor.yaml`` explains every entry.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_ins import yaml_reader
from hybrid_ins.bags.flight_bag import EPOCH_NS
from hybrid_ins.core.inertial.earth import STANDARD_GRAVITY
from hybrid_ins.core.inertial.rotations import UNKNOWN_ANGLE_STD
from hybrid_ins.dataset.csv_table import CsvFormat
from hybrid_ins.errors import InputError
from hybrid_ins.ros.messages.trajectory import Array

DELIMITERS = {"tab": "\t", "space": " "}
DEFAULT_EPOCH = EPOCH_NS * 1e-9

_MISSING = object()
_UNITS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "angle": {"rad": 1.0, "deg": np.pi / 180.0, "1e-7deg": 1e-7 * np.pi / 180.0},
    "acceleration": {"m/s2": 1.0, "g": STANDARD_GRAVITY, "mg": 1e-3 * STANDARD_GRAVITY},
    "rate": {"rad/s": 1.0, "deg/s": np.pi / 180.0},
    "number": {"1": 1.0},
}

Column = str | int


@dataclass(frozen=True)
class Source:
    """A file and its clock."""

    file: str  # name or pattern below the flight's directory; {imu} stands for the IMU's number
    layout: CsvFormat
    time_column: Column
    seconds_per_unit: float
    from_zero: bool  # the first stamp counts as zero


@dataclass(frozen=True, eq=False)
class Columns:
    """Some columns and what turns them into SI units."""

    names: tuple[Column, ...]
    factors: Array  # one for each name


@dataclass(frozen=True, eq=False)
class Orientation:
    """Columns that hold an attitude: roll, pitch, yaw, or the quaternion's x, y, z, w."""

    columns: Columns
    ned: bool  # FRD body in NED; else FLU body in ENU
    std: Array  # (3,) rad: roll, pitch, yaw


@dataclass(frozen=True, eq=False)
class ImuMap:
    """Of the IMU's file."""

    source: Source
    specific_force: Columns
    angular_rate: Columns
    C_flu: Array  # (3, 3) turns the columns' axes into forward, left, up
    orientation: Orientation | None


@dataclass(frozen=True, eq=False)
class PositionMap:
    """Of the reference position."""

    source: Source
    columns: Columns
    frame: str  # "ned", "enu" or "lla"
    origin_lla: Array | None  # (3,) rad, rad, m, of the local frame
    std: Array  # (3,) m: north, east, down


@dataclass(frozen=True, eq=False)
class AttitudeMap:
    """Of the reference attitude."""

    source: Source
    orientation: Orientation
    delay: float  # s


@dataclass(frozen=True, eq=False)
class ColumnMap:
    """A dataset."""

    epoch: float  # s since 1970, added to all times
    imu: ImuMap
    position: PositionMap
    attitude: AttitudeMap | None


def load_map(path: Path) -> ColumnMap:
    """
    Read and check a column map.

    Raises
    ------
    InputError
        No such file, no YAML, or an entry is missing, unknown or impossible.

    """
    top = _Section(path, "", yaml_reader.read(path, "a column map"))
    attitude = top.section("attitude", required=False)
    result = ColumnMap(
        top.number("epoch", DEFAULT_EPOCH),
        _imu_map(top.section("imu")),
        _position_map(top.section("position")),
        None if attitude is None else _attitude_map(attitude),
    )
    top.close()
    return result


def _imu_map(section: _Section) -> ImuMap:
    orientation = section.section("orientation", required=False)
    return ImuMap(
        _source(section),
        section.section("specific_force").columns(["acceleration"] * 3),
        section.section("angular_rate").columns(["rate"] * 3),
        section.axes("axes"),
        None if orientation is None else _orientation(orientation),
    )


def _position_map(section: _Section) -> PositionMap:
    frame = section.choice("frame", ("ned", "enu", "lla"))
    origin = None
    if frame != "lla":
        lat, lon, height = section.numbers("origin", 3)
        if not (abs(lat) < 90.0 and abs(lon) <= 360.0):
            raise section.refusal("origin", "latitude [deg], longitude [deg] and height [m]")
        origin = np.array([np.radians(lat), np.radians(lon), height])
    kinds = ["angle", "angle", "length"] if frame == "lla" else ["length"] * 3
    std = section.numbers("std", 3, above_zero=True)
    return PositionMap(_source(section), section.columns(kinds), frame, origin, np.array(std))


def _attitude_map(section: _Section) -> AttitudeMap:
    return AttitudeMap(_source(section), _orientation(section), section.number("delay", 0.0))


def _orientation(section: _Section) -> Orientation:
    is_quaternion = len(section.names()) == 4
    columns = section.columns(["number"] * 4 if is_quaternion else ["angle"] * 3)
    unknown = {"unknown": math.degrees(UNKNOWN_ANGLE_STD)}
    std = section.numbers("std", 3, above_zero=True, words=unknown)
    frames = section.choice("frames", ("frd in ned", "flu in enu"))
    return Orientation(columns, frames == "frd in ned", np.radians(std))


def _source(section: _Section) -> Source:
    delimiter = section.text("delimiter", ",")
    delimiter = DELIMITERS.get(delimiter, delimiter)
    if len(delimiter) != 1:
        raise section.refusal("delimiter", "one character, or tab, or space")
    time = section.section("time")
    columns = time.columns(["time"])
    return Source(
        section.text("file"),
        CsvFormat(delimiter, section.choice("header", ("yes", "no"), "yes") == "yes"),
        columns.names[0],
        float(columns.factors[0]),
        time.choice("starts", ("as stamped", "at zero"), "as stamped") == "at zero",
    )


class _Section:
    """A mapping of the file, whose entries are checked as they are read."""

    def __init__(self, path: Path, name: str, content: object) -> None:
        self.path, self.name = path, name
        if not isinstance(content, dict):
            raise InputError(f"{path}: {name or 'the file'} holds no entries 'name: value'")
        self._content: dict[object, object] = content
        self._taken: set[object] = set()
        self._sections: list[_Section] = []

    def close(self) -> None:
        """Refuse entries that are not part of a column map."""
        for key in self._content:
            if key not in self._taken:
                known = ", ".join(sorted(map(str, self._taken)))
                raise InputError(
                    f"{self.path}: {self._place(str(key)[:40])} is not an entry of a column map;"
                    f" known here: {known}"
                )
        for section in self._sections:
            section.close()

    def section(self, key: str, required: bool = True) -> Any:
        """Return a part as a section, or None where it may be and is missing."""
        content = self._get(key, _MISSING if required else None)
        if content is None:
            return None
        section = _Section(self.path, self._place(key), content)
        self._sections.append(section)
        return section

    def text(self, key: str, default: object = _MISSING) -> str:
        value = self._get(key, default)
        if not isinstance(value, str) or not value:
            raise self.refusal(key, "a text")
        return value

    def choice(self, key: str, choices: Sequence[str], default: object = _MISSING) -> str:
        value = self._get(key, default)
        value = {True: "yes", False: "no"}.get(value, value) if isinstance(value, bool) else value
        if not isinstance(value, str) or value not in choices:
            raise self.refusal(key, " or ".join(f"'{choice}'" for choice in choices))
        return value

    def number(self, key: str, default: object = _MISSING) -> float:
        value = self._get(key, default)
        if not _is_number(value):
            raise self.refusal(key, "a number")
        return float(value)  # type: ignore[arg-type]

    def numbers(
        self, key: str, length: int, above_zero: bool = False, words: dict[str, float] | None = None
    ) -> list[float]:
        values = self._list(key, length)
        values = [words.get(v, v) if words and isinstance(v, str) else v for v in values]
        if not all(_is_number(v) and (v > 0.0 or not above_zero) for v in values):
            raise self.refusal(key, f"a list of {length} numbers{' above zero' * above_zero}")
        return [float(v) for v in values]

    def names(self) -> list[Column]:
        """Return the column names under ``columns``, or the one under ``column``."""
        key = "column" if "column" in self._content else "columns"
        value = self._get(key)
        names = value if isinstance(value, list) else [value]
        if not names or not all(
            (isinstance(n, str) and n) or (type(n) is int and n > 0) for n in names
        ):
            raise self.refusal(key, "a list of column names, or of column numbers from 1")
        return names

    def columns(self, kinds: Sequence[str]) -> Columns:
        """Return the columns, one of each kind of unit."""
        names = self.names()
        if len(names) != len(kinds):
            raise self.refusal("columns", f"{len(kinds)} columns, not {len(names)}")
        units = self._get("unit", "1" if set(kinds) == {"number"} else _MISSING)
        units = units if isinstance(units, list) else [units] * len(kinds)
        if len(units) != len(kinds):
            raise self.refusal("unit", f"one unit, or a list of {len(kinds)}")
        factors = [self._factor(unit, kind) for unit, kind in zip(units, kinds, strict=True)]
        return Columns(tuple(names), np.array(factors))

    def axes(self, key: str) -> Array:
        """Return the matrix (3, 3) from the columns' axes to forward, left, up."""
        value = self._get(key, "flu")
        value = {"flu": ["x", "y", "z"], "frd": ["x", "-y", "-z"]}.get(str(value), value)
        matrix = np.zeros((3, 3))
        if isinstance(value, list) and len(value) == 3:
            for row, axis in enumerate(value):
                sign, letter = (-1.0, axis[1:]) if str(axis).startswith("-") else (1.0, axis)
                if letter in ("x", "y", "z"):
                    matrix[row, "xyz".index(letter)] = sign
        if not np.isclose(np.linalg.det(matrix), 1.0):
            raise self.refusal(
                key,
                "flu, frd, or the columns' axes that point forward, left and up, such as"
                " [y, -x, z], and right-handed",
            )
        return matrix

    def refusal(self, key: str, wanted: str) -> InputError:
        return InputError(f"{self.path}: {self._place(key)} must be {wanted}")

    def _factor(self, unit: object, kind: str) -> float:
        if _is_number(unit) and unit > 0.0:  # type: ignore[operator]
            return float(unit)  # type: ignore[arg-type]
        if isinstance(unit, str) and unit in _UNITS[kind]:
            return _UNITS[kind][unit]
        known = ", ".join(_UNITS[kind])
        raise self.refusal("unit", f"a unit of {kind} ({known}), or a number of SI units")

    def _list(self, key: str, length: int) -> list[Any]:
        value = self._get(key)
        if not isinstance(value, list) or len(value) != length:
            raise self.refusal(key, f"a list of {length}")
        return value

    def _get(self, key: str, default: object = _MISSING) -> Any:
        self._taken.add(key)
        value = self._content.get(key, default)
        if value is _MISSING:
            raise InputError(f"{self.path}: {self._place(key)} is missing")
        return value

    def _place(self, key: str) -> str:
        return f"{self.name}.{key}" if self.name else key


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and np.isfinite(value)
