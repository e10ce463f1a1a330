"""
What the air tells of the velocity of real aircraft: sideslip of a fixed wing, drag of copters.

Then outages cut into the flight of the fixed wing, without and with ``vehicle.kind: fixed_wing``,
and with scale errors of the IMU considered and ignored.

The wind, and the drag of a copter, are fitted to 90 s with fixes. What they make of the next 30 s
without is compared with the receiver's velocity; the attitude is that of the autopilot.

References
----------
.. [1] P. Groves, *Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems*,
       2nd ed., section 15.4.
.. [2] R. Leishman, J. Macdonald, R. Beard, T. McLain, "Quadrotors and accelerometers", IEEE
       Control Systems 34, 2014: the specific force across the rotors is the drag.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybrid_ins import parameters
from hybrid_ins.cli import options, program
from hybrid_ins.core.inertial.rotations import matrix_from_quat, quat_from_rpy
from hybrid_ins.ros.messages.trajectory import Array
from tools.vehicles import drives as vehicle_drives
from tools.vehicles.outages import BETWEEN as BETWEEN_OUTAGES
from tools.vehicles.outages import HEADER as OUTAGES_HEADER
from tools.vehicles.outages import JUDGED as JUDGED_AFTER
from tools.vehicles.outages import LENGTH, VARIANTS, End, ends
from tools.vehicles.outages import row as outage_row

FITTED, JUDGED, BETWEEN = 90.0, 30.0, 15.0  # s: to fit, to judge, between two trials
SHIFTS = np.arange(15.0, 135.0, 20.0)  # s after take-off, of the first outage of each run
SMOOTH = 25  # samples, half a second
SMALLEST_SPEED = 1.0  # m/s, of a copter that flies
AXES = ("ax", "ay", "az")  # of imu.csv, FLU
AIR_VARIANTS = (
    "none",
    "none, scale errors ignored",
    "fixed wing",
    "fixed wing, scale errors ignored",
)
AIRBORNE = {"plane_x8": (275.0, 575.0)}  # s
VELOCITY_AGE = {"plane_x8": 0.31, "quad106": 0.24, "quad_low": 0.28}  # s, by the data's README


class Flight(NamedTuple):
    """A flight at the times of its fixes, in the air."""

    t: Array  # (N,) s
    velocity_n: Array  # (N, 3) m/s
    C_nb: Array  # (N, 3, 3)
    force_b: Array  # (N, 3) m/s², mean over half a second


def load(folder: Path) -> Flight:
    """Return the flight of a folder."""
    gnss = np.genfromtxt(folder / "gnss.csv", delimiter=",", names=True)
    attitude = np.genfromtxt(folder / "attitude.csv.gz", delimiter=",", names=True)
    imu = np.genfromtxt(folder / "imu.csv.gz", delimiter=",", names=True)
    t = gnss["t"] - VELOCITY_AGE[folder.name]
    velocity_n = np.stack((gnss["vn"], gnss["ve"], -gnss["vu"]), axis=1)
    angles = [np.unwrap(np.radians(attitude[name])) for name in ("roll", "pitch", "yaw")]
    rpy = [np.interp(t, attitude["t"], angle) for angle in angles]
    force = [np.convolve(imu[name], np.full(SMOOTH, 1.0 / SMOOTH), "same") for name in AXES]
    force_b = np.stack([np.interp(t, imu["t"], axis) for axis in force], axis=1) * [1, -1, -1]
    if folder.name in AIRBORNE:
        begin, end = AIRBORNE[folder.name]
        kept = (t > begin) & (t < end)
    else:
        fast = np.linalg.norm(velocity_n[:, :2], axis=1) > SMALLEST_SPEED
        kept = np.convolve(fast, np.full(50, 0.02), "same") > 0.3
    C_nb = matrix_from_quat(quat_from_rpy(*rpy))
    return Flight(t[kept], velocity_n[kept], C_nb[kept], force_b[kept])


def trials(t: Array) -> Iterator[tuple[NDArray[np.bool_], NDArray[np.bool_]]]:
    """Yield which of the times (N,) are to fit, and which to judge."""
    for start in np.arange(t[0] + FITTED, t[-1] - JUDGED, BETWEEN):
        fitted, judged = (t < start) & (t > start - FITTED), (t >= start) & (t < start + JUDGED)
        if fitted.sum() > FITTED and judged.sum() > JUDGED:
            yield fitted, judged


def sideslip(flight: Flight) -> Array:
    """Return errors (K, N, 1) of the velocity to the right, by no sideslip in a constant wind."""
    right_n = flight.C_nb[:, :, 1]
    across = np.sum(right_n * flight.velocity_n, axis=1)
    found = []
    for fitted, judged in trials(flight.t):
        wind, *_ = np.linalg.lstsq(right_n[fitted, :2], across[fitted], rcond=None)
        found.append((across - right_n[:, :2] @ wind)[judged, None])
    return _cut(found)


def drag(flight: Flight, *, windy: bool) -> tuple[Array, Array]:
    """
    Return errors (K, N, 2) of the velocity forward and to the right, and the drag (K,) [1/s].

    f = -k (C_nb' (v - wind)) + b, forward and to the right; the wind is fitted where ``windy``.
    """
    velocity_b = np.einsum("kji,kj->ki", flight.C_nb, flight.velocity_n)[:, :2]
    found, drags = [], []
    for fitted, judged in trials(flight.t):
        bias = np.tile(np.eye(2), (len(flight.t), 1, 1))
        by_wind = np.swapaxes(flight.C_nb[:, :2, :2], 1, 2) * windy
        columns = np.concatenate((-velocity_b[:, :, None], bias, by_wind), axis=2)
        of_fit = columns[fitted].reshape(-1, 5), flight.force_b[fitted, :2].ravel()
        x, *_ = np.linalg.lstsq(*of_fit, rcond=None)
        rest = flight.force_b[:, :2] - columns[:, :, 1:] @ x[1:]
        found.append((velocity_b + rest / x[0])[judged])
        drags.append(x[0])
    return _cut(found), np.array(drags)


def _cut(errors: Sequence[Array]) -> Array:
    """Return errors of the same length as one array."""
    size = min(map(len, errors))
    return np.stack([error[:size] for error in errors])


def row(name: str, law: str, errors: Array, note: str) -> str:
    """Return the row of a table."""
    rms = np.sqrt(np.mean(np.sum(errors**2, axis=2)))
    mean = np.sqrt(np.mean(np.sum(errors.mean(axis=1) ** 2, axis=1)))
    return f"| {name} | {law} | {len(errors)} | {rms:.1f} | {mean:.1f} | {note} |"


HEADER = (
    "| flight | law | trials | rms [m/s] | of the mean over 30 s | found |\n" + "|---" * 6 + "|"
)


def outages(folder: Path) -> Iterator[str]:
    """Yield the rows of outages of a flight with the default parameters."""
    drive, (begin, end) = vehicle_drives.load(folder, "all"), AIRBORNE[folder.name]
    for variant in AIR_VARIANTS:
        found: list[End] = []
        for shift in SHIFTS:
            starts = np.arange(begin + shift, end - LENGTH, LENGTH + BETWEEN_OUTAGES)
            values = {**parameters.defaults(), **VARIANTS[variant]}
            found += ends(drive, values, starts=starts)
        yield from (outage_row(folder.name, variant, found, after) for after in JUDGED_AFTER)


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = program.parser("air", __doc__ or "")
    parser.add_argument("data", type=options.path, metavar="DIR", help="folder of the real sets")
    return program.run(_body, parser.parse_args(argv))


def _body(args: argparse.Namespace) -> int:
    data = args.data
    plane = load(data / "plane_x8")
    print(HEADER)
    print(row("plane_x8", "no sideslip", sideslip(plane), ""))
    for name in ("quad106", "quad_low"):
        flight = load(data / name)
        for windy, law in ((False, "drag, no wind"), (True, "drag, constant wind")):
            errors, k = drag(flight, windy=windy)
            print(row(name, law, errors, f"{k.mean():.2f} ± {k.std():.2f} /s"))
    print(OUTAGES_HEADER)
    for line in outages(data / "plane_x8"):
        print(line, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
