"""
What a filter has found, as a file for the next start: biases, clock offset, noise, pose.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from hybrid_ins import yaml_reader
from hybrid_ins.core.alignment.alignment import Biases
from hybrid_ins.core.inertial.rotations import matrix_from_quat, quat_from_rpy, rpy_from_quat
from hybrid_ins.core.inertial.state import NavState, total_std
from hybrid_ins.errors import InputError
from hybrid_ins.output_file import write_text

Array = NDArray[np.float64]

VERSION = 1
HEADING = """\
# What ins_node has found, for its next start (parameter state_file). Written by it; delete the file
# to start without. Axes are forward, right, down; angles are in degrees.
"""
BOUNDS = {
    "accelerometer_bias": 10.0,
    "gyroscope_bias": 1.0,
    "accelerometer_bias_std": 10.0,
    "gyroscope_bias_std": 1.0,
    "clock_offset": 10.0,
    "latitude": 90.0,
    "longitude": 360.0,
    "height": 1e6,
    "position_std": 1e6,
    "roll": 360.0,
    "pitch": 360.0,
    "heading": 360.0,
    "heading_std": 360.0,
    "noise_variance": 1e6,
}
LENGTHS = {name: 3 for name in BOUNDS if "bias" in name} | {"noise_variance": 6}


@dataclass(frozen=True, slots=True)
class SavedState:
    """
    The contents of the file.

    Attributes
    ----------
    version : int
    stamp_ns : int
        Of the IMU sample [ns].
    standing : bool
        The vehicle stood.
    latitude, longitude : float
        Of the IMU [deg].
    height, position_std : float
        Above the ellipsoid, horizontal [m].
    heading, heading_std, roll, pitch : float
        [deg], heading from north, clockwise.
    accelerometer_bias, accelerometer_bias_std, gyroscope_bias, gyroscope_bias_std : list of float
        b [m/s², rad/s].
    noise_variance : list of float
        Of one reading, accelerometer first, b; for information.
    clock_offset : float
        Added to the stamps of fixes [s].
    """

    version: int
    stamp_ns: int
    standing: bool
    latitude: float
    longitude: float
    height: float
    position_std: float
    heading: float
    heading_std: float
    roll: float
    pitch: float
    accelerometer_bias: list[float]
    accelerometer_bias_std: list[float]
    gyroscope_bias: list[float]
    gyroscope_bias_std: list[float]
    noise_variance: list[float]
    clock_offset: float

    @classmethod
    def of(
        cls, nav: Array, t_ns: int, standing: bool, noise_variance: Array, clock_offset: float
    ) -> SavedState:
        """Return what to save of a filter's flat state at a stamp [ns]."""
        state, sigma = NavState.from_flat(nav), total_std(nav)
        roll, pitch, yaw = np.degrees(rpy_from_quat(state.quat_xyzw)).tolist()
        latitude, longitude = np.degrees(state.lla[:2]).tolist()
        return cls(
            VERSION,
            t_ns,
            standing,
            latitude,
            longitude,
            float(state.lla[2]),
            float(math.hypot(*sigma[:2])),
            yaw % 360.0,
            math.degrees(sigma[8]),
            roll,
            pitch,
            state.bias_a.tolist(),
            sigma[9:12].tolist(),
            state.bias_g.tolist(),
            sigma[12:15].tolist(),
            np.asarray(noise_variance).tolist(),
            float(clock_offset),
        )

    def write(self, path: Path) -> None:
        """Write the file, complete or not at all."""
        text = yaml.safe_dump(asdict(self), sort_keys=False, default_flow_style=None)
        write_text(path, HEADING + text)

    @classmethod
    def read(cls, path: Path) -> SavedState:
        """
        Read a file.

        Raises
        ------
        InputError
            It is missing, no such file, of another version, or a value is impossible.
        """
        content = yaml_reader.read(path, "a saved state")
        if not isinstance(content, dict) or content.get("version") != VERSION:
            raise InputError(f"{path}: no saved state of version {VERSION}: delete it")
        names = {field.name for field in fields(cls)}
        if content.keys() != names:
            missing = ", ".join(sorted(names ^ content.keys()))
            raise InputError(f"{path}: a saved state without or with other values: {missing}")
        for name, limit in BOUNDS.items():
            _check(path, name, content[name], limit)
        if not isinstance(content["stamp_ns"], int) or not isinstance(content["standing"], bool):
            raise InputError(f"{path}: stamp_ns or standing has another type: delete the file")
        return cls(**content)

    @property
    def lla(self) -> Array:
        """Latitude, longitude [rad] and height [m] of the IMU, shape (3,)."""
        return np.array([math.radians(self.latitude), math.radians(self.longitude), self.height])

    @property
    def down_b(self) -> Array:
        """Direction of gravity in b, shape (3,)."""
        quat = quat_from_rpy(math.radians(self.roll), math.radians(self.pitch), 0.0)
        return np.asarray(matrix_from_quat(quat)[2])

    @property
    def biases(self) -> Biases:
        """The biases as alignment uses them."""
        std = np.array(self.accelerometer_bias_std + self.gyroscope_bias_std)
        return Biases(
            self.stamp_ns,
            np.array(self.accelerometer_bias),
            np.array(self.gyroscope_bias),
            np.diag(std**2),
        )


def _check(path: Path, name: str, value: Any, limit: float) -> None:
    """Refuse what is no number within a limit, or no list of them."""
    numbers = value if isinstance(value, list) else [value]
    length = LENGTHS.get(name)
    is_number = all(isinstance(v, int | float) and not isinstance(v, bool) for v in numbers)
    if (
        not is_number
        or isinstance(value, list) is (length is None)
        or (length is not None and len(numbers) != length)
        or not all(abs(v) <= limit for v in numbers)
        or (name.endswith(("_std", "variance")) and min(numbers) < 0.0)
    ):
        raise InputError(f"{path}: {name}: {str(value)[:60]} is not possible: delete the file")
