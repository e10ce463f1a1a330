"""Whether the vehicle moves along its nose, where that points, and where its axle is."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.calibration import wheels
from hybrid_ins.calibration.derived import courses, travel
from hybrid_ins.calibration.filter_pass import FilterPass
from hybrid_ins.calibration.findings import Finding
from hybrid_ins.calibration.recording import Recording
from hybrid_ins.core.constraints.constraint_observer import (
    SHOWN,
    ConstraintObserver,
    ConstraintSettings,
)
from hybrid_ins.core.constraints.nonholonomic import Nose
from hybrid_ins.ros.messages.conversions import FLIP

Array = NDArray[np.float64]
Motion = tuple[Sequence[FilterPass], Sequence[float]]  # over each recording, and its clock offset

INTERVAL = 0.5  # s, at least, between two observations
RATE_TIME = 0.03  # s, before and after an observation, of samples whose mean is the angular rate
NOSE_STD, POINT_STD, SLIP_STD = 0.1, 1.5, 0.1  # rad, m, m/s: before the motion is known
FEWEST_OBSERVATIONS = 20  # observations
NOSE_IDENTIFIED, AXLE_IDENTIFIED = math.radians(0.3), 0.3  # rad, m: largest σ
SLIP_IDENTIFIED = 0.35  # largest σ of its logarithm


def observe_nose(
    recordings: Sequence[Recording], after: Sequence[FilterPass], offsets: Sequence[float]
) -> ConstraintObserver | None:
    """
    Observe the motion of recordings; None where there is none to speak of.

    Parameters
    ----------
    recordings : sequence of Recording
    after : sequence of FilterPass
        The filter over each, with its states.
    offsets : sequence of float
        Clock offset of the fixes of each [s].

    Returns
    -------
    ConstraintObserver or None
        Its nose and point are in b of the samples, relative to the IMU.
    """
    angles = np.concatenate([courses(one) for one in after])
    if len(angles) < FEWEST_OBSERVATIONS:
        return None
    settings = ConstraintSettings(
        Nose(travel(angles).angle, 0.0, np.zeros(3)),
        NOSE_STD,
        POINT_STD,
        np.full(2, SLIP_STD),
        False,
    )
    observer = ConstraintObserver(settings)
    for recording, one, offset in zip(recordings, after, offsets, strict=True):
        t_fix = recording.aid_t + offset
        last = -math.inf
        for k in np.flatnonzero(np.isfinite(one.nis)).tolist():
            low, high = np.searchsorted(recording.t, (t_fix[k] - RATE_TIME, t_fix[k] + RATE_TIME))
            if t_fix[k] - last < 0.9 * INTERVAL or high <= low:
                continue
            interval = min(t_fix[k] - last, 1.0)
            last = t_fix[k]
            rate_b = recording.samples[low:high, 3:].mean(axis=0)
            observer.observe(one.states[k], rate_b, interval, fused=False)
    return observer


def vehicle_findings(
    recordings: Sequence[Recording],
    after: Sequence[FilterPass],
    offsets: Sequence[float],
    C_new_old: Array,
    values: Mapping[str, Any],
    imu_position: Array,
    wrong: Sequence[Motion] = (),
) -> list[Finding]:
    """
    Return what the motion shows of the vehicle: its nose and axle, its wheels.

    Parameters as in `observe_nose` and `wheels.observe_wheels`; ``imu_position`` (3,) is that which
    was found [m, FLU], and ``wrong`` are the passes and offsets with each error of parameters that
    are held: nose and axle move with it.
    """
    rows: list[Finding] = []
    nose = observe_nose(recordings, after, offsets)
    if nose is not None and nose.holds:
        moved = _moved_by(recordings, wrong)
        slip_std = np.array(values["vehicle.slip_std"])
        rows += findings_of(nose, C_new_old, imu_position.tolist(), moved, slip_std)
    sensor = wheels.observe_wheels(recordings, after, offsets, C_new_old, values)
    if sensor is not None:
        rows += wheels.findings_of(sensor, values, imu_position - values["imu.position"])
    return rows


def _moved_by(recordings: Sequence[Recording], motions: Sequence[Motion]) -> Array:
    """
    Return how far errors move the nose's yaw and pitch [rad] and the axle along it [m], (3,).

    The first of ``motions`` is that without error.
    """
    places = []
    for passes, offsets in motions:
        found = observe_nose(recordings, passes, offsets)
        if found is not None:
            nose = found.nose
            places.append([nose.yaw, nose.pitch, float(nose.forward @ nose.point_b)])
    if not places:
        return np.zeros(3)
    return np.asarray(np.linalg.norm(np.array(places[1:]).reshape(-1, 3) - places[0], axis=0))


def findings_of(
    observer: ConstraintObserver,
    C_new_old: Array,
    imu_position: Sequence[float],
    moved: Array,
    nominal: Array,
) -> list[Finding]:
    """
    Return what was found of a vehicle that moves along its nose.

    A boat that hardly drifts does so, too: the kind is ground where the motion across the nose is
    no more than the constraint allows for. Otherwise another drive has to show it by itself.

    Parameters
    ----------
    observer : ConstraintObserver
    C_new_old : ndarray, shape (3, 3)
        From b of the samples to that of the parameters.
    imu_position : sequence of float
        Position of the IMU in the base frame (forward, left, up) [m].
    moved : ndarray, shape (3,)
        How far parameters that are held, maybe wrongly, move the nose [rad] and the axle [m].
    nominal : ndarray, shape (2,)
        Velocity across the nose, left and up [m/s], with which the constraint is used.
    """
    forward = C_new_old @ observer.nose.forward
    yaw = -math.degrees(math.atan2(forward[1], forward[0]))
    pitch = -math.degrees(math.atan2(forward[2], math.hypot(forward[0], forward[1])))
    axle = np.add(imu_position, FLIP @ C_new_old @ observer.nose.point_b)
    slip_std = np.sqrt(np.diag(observer.slip.covariance))
    yaw_std, pitch_std, along_std = np.hypot(observer.sigma[:3], moved).tolist()
    sigma = max(yaw_std, pitch_std)
    rolls = observer.evidence > SHOWN and bool(np.all(slip_std <= nominal))
    kind, note = {}, "not surely on wheels: vehicle.kind as given"
    if rolls:
        kind, note = {"vehicle.kind": "ground"}, "as on wheels: kind ground"
    return [
        Finding(
            "nose",
            f"yaw {yaw:+.2f}°, pitch {pitch:+.2f}°",
            f"{math.degrees(sigma):.2f}°",
            "identified" if sigma < NOSE_IDENTIFIED else "weak",
            f"the vehicle moves along it, {note}",
            {
                **kind,
                "vehicle.nose": [round(math.radians(angle), 4) for angle in (yaw, pitch)],
                "vehicle.nose_std": float(f"{sigma:.2g}"),
            },
        ),
        Finding(
            "axle forward",
            f"{axle[0]:+.2f} m",
            f"{along_std:.2f} m",
            "identified" if along_std < AXLE_IDENTIFIED else "weak",
            "point that does not slip",
            {
                "vehicle.axle_position": [round(float(a), 3) for a in axle],
                "vehicle.axle_position_std": float(f"{along_std:.2g}"),
            },
        ),
        Finding(
            "slip left, up",
            f"{slip_std[0]:.3f}, {slip_std[1]:.3f} m/s",
            f"×/÷ {math.exp(float(np.max(observer.slip.spread))):.1f}",
            "identified" if np.max(observer.slip.spread) < SLIP_IDENTIFIED else "weak",
            "velocity across the nose on these roads",
        ),
    ]
