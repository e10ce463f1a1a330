"""Scale and place of wheels, or of another sensor of velocity, from calibrated recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.calibration.filter_pass import FilterPass
from hybrid_ins.calibration.findings import Finding, Verdict
from hybrid_ins.calibration.recording import Recording
from hybrid_ins.core.aiding.measurements import BodyVelocity
from hybrid_ins.core.aiding.sensors import VelocitySensor
from hybrid_ins.core.inertial.rotations import matrix_from_quat, quat_from_matrix
from hybrid_ins.core.inertial.state import (
    B_A,
    B_G,
    BIAS_A,
    BIAS_G,
    COVARIANCE,
    LAST_W,
    N_ERROR,
    QUAT,
    covariance,
    pack,
)
from hybrid_ins.ros.messages.conversions import FLIP

Array = NDArray[np.float64]

NEAR_NS = 120_000_000  # between a state and the readings before and after it
FEWEST_READINGS = 20  # readings
SCALE_IDENTIFIED, PLACE_IDENTIFIED = 0.003, 0.1  # -, m: largest σ
LARGEST_NIS = 5.0  # mean per component, of a sensor that fits
AXES = ("forward", "left", "up")


def observe_wheels(
    recordings: Sequence[Recording],
    after: Sequence[FilterPass],
    offsets: Sequence[float],
    C_new_old: Array,
    values: Mapping[str, Any],
) -> VelocitySensor | None:
    """
    Compare the readings of wheels with the motion; None where there are too few.

    Parameters
    ----------
    recordings : sequence of Recording
    after : sequence of FilterPass
        The filter over each, with its states.
    offsets : sequence of float
        Clock offset of the fixes of each [s].
    C_new_old : ndarray, shape (3, 3)
        From b of the samples to that of the parameters, in which the readings are.
    values : mapping
        Nominal parameters.
    """
    sensor = VelocitySensor(
        values["aiding.velocity_scale"],
        values["aiding.velocity_scale_std"],
        np.broadcast_to(values["aiding.velocity_position_std"], 3),
    )
    count, begin_ns = 0, 0
    for recording, one, offset in zip(recordings, after, offsets, strict=True):
        begin_ns += 10**12  # the sensor's clock goes on
        t_ns = np.array([reading.t_ns for reading in recording.body_velocity], np.int64)
        at_ns = np.round((recording.aid_t + offset) * 1e9).astype(np.int64)
        for k in np.flatnonzero(np.isfinite(one.nis)).tolist():
            last = int(np.searchsorted(t_ns, at_ns[k]))
            if not 0 < last < len(t_ns) or t_ns[last] - t_ns[last - 1] > 2 * NEAR_NS:
                continue
            before, behind = recording.body_velocity[last - 1 : last + 1]
            reading = _between(before, behind, int(at_ns[k]))
            near = np.abs(recording.t - at_ns[k] * 1e-9) < NEAR_NS * 0.5e-9
            rate_b = recording.samples[near, 3:].mean(axis=0)
            nav = _turned(one.states[k], rate_b, C_new_old)
            if sensor.admit(begin_ns + reading.t_ns):
                sensor.check(reading, nav, checked=True, outage=False)
                count += 1
    return sensor if count >= FEWEST_READINGS else None


def _between(first: BodyVelocity, second: BodyVelocity, t_ns: int) -> BodyVelocity:
    """Return the reading on the line between two, at a stamp [ns]."""
    share = (t_ns - first.t_ns) / max(second.t_ns - first.t_ns, 1)
    velocity_b = first.velocity_b + share * (second.velocity_b - first.velocity_b)
    return replace(second, t_ns=t_ns, velocity_b=velocity_b)


def _turned(state: Array, rate_b: Array, C_new_old: Array) -> Array:
    """Return a flat state with the angular rate (3,), in the axes of the parameters."""
    nav = state.copy()
    nav[QUAT] = quat_from_matrix(matrix_from_quat(nav[QUAT]) @ C_new_old.T)
    nav[BIAS_A], nav[BIAS_G] = C_new_old @ nav[BIAS_A], C_new_old @ nav[BIAS_G]
    nav[LAST_W] = C_new_old @ rate_b
    turn = np.eye(N_ERROR)
    turn[B_A, B_A] = turn[B_G, B_G] = C_new_old
    pack(turn @ covariance(state) @ turn.T, nav[COVARIANCE])
    return nav


def findings_of(sensor: VelocitySensor, values: Mapping[str, Any], moved: Array) -> list[Finding]:
    """
    Return what was found of scale and place; no parameters follow where the sensor does not fit.

    ``values`` are the nominal ones, from which the IMU's position was ``moved`` (3,) [m], FLU.
    """
    sigma = sensor.sigma
    trouble = f"mean NIS {sensor.nis:.0f} per component" if sensor.nis >= LARGEST_NIS else ""
    if sensor.has_changed:
        trouble = "the scale changes within the recordings"
    given_std = np.broadcast_to(values["aiding.velocity_position_std"], 3)
    place = np.add(values["aiding.velocity_position"], FLIP @ sensor.shift_b + moved)

    def verdict(std: float, largest: float, given: float) -> Verdict:
        if trouble:
            return "does not fit"
        if std > 0.7 * given:
            return "not identifiable"
        return "identified" if std < largest else "weak"

    rows = [
        Finding(
            "wheel scale",
            f"{sensor.scale:.4f}",
            f"{sigma[0]:.4f}",
            verdict(float(sigma[0]), SCALE_IDENTIFIED, values["aiding.velocity_scale_std"]),
            f"{trouble}: check axes and stamps" if trouble else "",
            {
                "aiding.velocity_scale": round(float(sensor.scale), 5),
                "aiding.velocity_scale_std": float(f"{sigma[0]:.2g}"),
            },
        )
    ]
    for name, metres, std, given in zip(AXES, place, sigma[1:], given_std, strict=True):
        known = verdict(float(std), PLACE_IDENTIFIED, float(given))
        note = "no axis or no turn shows it" if known == "not identifiable" else ""
        rows.append(Finding(f"wheels {name}", f"{metres:+.2f} m", f"{std:.2f} m", known, note))
    rows[-1] = replace(
        rows[-1],
        values={
            "aiding.velocity_position": [round(float(metres), 3) for metres in place],
            "aiding.velocity_position_std": [float(f"{std:.2g}") for std in sigma[1:]],
        },
    )
    return [replace(row, values={}) for row in rows] if trouble else rows
