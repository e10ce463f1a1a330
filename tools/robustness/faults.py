"""
What goes wrong in the field: named faults, each with what the estimator has to say about it.

A fault changes the messages of a recorded flight from ``start`` on, for its duration. Its signs are
what must be found in what the estimator publishes: a counter or a text of ``/diagnostics``, or a
reason of ``gnss/verdict``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hybrid_ins.ros.messages.conversions import DIAGONAL
from tools.robustness.disturbances import (
    FIX,
    IMU,
    INDEFINITE,
    INF,
    NAN,
    Injection,
    always,
    bag_loop,
    both,
    change_fixes,
    change_force,
    change_frame_id,
    change_rate,
    change_stamps,
    clock_jump,
    drift,
    first_fix_wild,
    fix_burst,
    fix_frozen,
    fix_late,
    fix_repeated,
    imu_covariances,
    imu_frozen,
    imu_interpolated,
    imu_no_reading,
    imu_noise,
    imu_saturated,
    imu_two_publishers,
    insert_pose,
    insert_velocity,
    late_start,
    moved_north,
    repeat_stamps,
    stray_frame_id,
    swap_in_time,
    with_attributes,
    with_covariance,
    with_status,
)


@dataclass(frozen=True)
class Fault:
    """
    One way to go wrong.

    Attributes
    ----------
    name, text : str
        Short name; what happens.
    inject : callable
        Changes a flight.
    signs : tuple of str
        Texts that the diagnostics, verdicts or log lines must contain.
    duration : float
        [s].
    values : mapping
        Parameters that differ from the defaults.
    stamp_shift : float
        Stamps after the fault are those of the clean flight plus this [s].
    silent : bool
        The right answer is to publish no odometry at all.
    unusable : bool
        The input is wrong for good: the fault has to be named, no estimate has to be good.
    """

    name: str
    text: str
    inject: Injection
    signs: tuple[str, ...]
    duration: float = 5.0
    values: Mapping[str, Any] = field(default_factory=dict)
    stamp_shift: float = 0.0
    silent: bool = False
    unusable: bool = False


FAULTS: tuple[Fault, ...] = (
    # Readings of the IMU.
    Fault(
        "imu_nan",
        "one acceleration in ten is NaN",
        change_force(lambda f, _: (NAN, *f[1:]), 0.1),
        ("imu: not finite",),
    ),
    Fault(
        "imu_inf",
        "one rate in ten is infinite",
        change_rate(lambda w, _: (*w[:2], INF), 0.1),
        ("imu: not finite",),
    ),
    Fault(
        "imu_nan_long",
        "nothing but NaN for 3 s",
        change_force(lambda f, _: (NAN, NAN, NAN)),
        ("imu: not finite", "restart: no IMU samples"),
        3.0,
    ),
    Fault(
        "imu_absurd_force",
        "one acceleration in ten is 1e6 m/s²",
        change_force(lambda f, _: 1e6 * np.sign(f), 0.1),
        ("imu: absurd acceleration",),
    ),
    Fault(
        "imu_absurd_rate",
        "one rate in ten is 1e9 rad/s",
        change_rate(lambda w, _: (1e9, 0.0, 0.0), 0.1),
        ("imu: absurd rate",),
    ),
    Fault(
        "imu_huge_values",
        "one message in ten holds 1e308",
        both(
            change_force(lambda f, _: (1e308,) * 3, 0.1),
            change_rate(lambda w, _: (-1e308,) * 3, 0.1),
        ),
        ("imu: absurd acceleration",),
    ),
    Fault(
        "imu_zeros",
        "all readings are zero",
        both(change_force(lambda f, _: (0.0,) * 3), change_rate(lambda w, _: (0.0,) * 3)),
        ("imu: no acceleration",),
    ),
    Fault(
        "imu_half_filled",
        "the acceleration is left zero",
        change_force(lambda f, _: (0.0,) * 3),
        ("imu: no acceleration",),
    ),
    Fault(
        "imu_gravity_removed",
        "the driver removes gravity",
        change_force(lambda f, _: f - np.array([0.0, 0.0, 9.8])),
        ("imu: no gravity",),
    ),
    Fault(
        "imu_in_g",
        "accelerations in g",
        change_force(lambda f, _: f / 9.80665),
        ("the unit seems to be g",),
    ),
    Fault(
        "imu_in_mg",
        "accelerations in mg",
        change_force(lambda f, _: f * 101.97),
        ("imu: absurd acceleration",),
    ),
    Fault(
        "imu_degrees",
        "rates in degrees per second",
        change_rate(lambda w, _: np.degrees(w)),
        ("imu: degrees|imu: absurd rate",),
    ),
    Fault("imu_frozen", "the same reading again and again", imu_frozen, ("imu: frozen",)),
    Fault(
        "imu_interpolated",
        "a gap of 1.5 s is filled along a line",
        imu_interpolated,
        ("imu: interpolated",),
        1.5,
    ),
    Fault(
        "imu_saturated",
        "vibration beyond the accelerometer's range",
        imu_saturated,
        ("imu: saturated",),
    ),
    Fault("imu_no_reading", "covariance[0] is -1", imu_no_reading, ("imu: no reading",)),
    Fault(
        "imu_covariances", "covariances are NaN, zero, infinite", imu_covariances, ("no restart",)
    ),
    Fault("imu_vibration", "a hundred times the noise", imu_noise, ("no restart",)),
    Fault(
        "imu_bias_steps",
        "biases step by 0.1 m/s², 0.2°/s, and back",
        both(change_force(lambda f, _: f + 0.1), change_rate(lambda w, _: w + 0.0035)),
        ("no restart",),
    ),
    Fault(
        "imu_spikes",
        "one acceleration in a hundred is 60 m/s² off",
        change_force(lambda f, _: f + np.array([60.0, -60.0, 60.0]), 0.01),
        ("imu: spikes", "no restart"),
    ),
    Fault(
        "imu_two_publishers",
        "a second IMU on the topic",
        imu_two_publishers,
        ("imu: repeated stamp", "imu/data: frame_id changes"),
    ),
    Fault(
        "imu_frame_id",
        "the frame_id changes",
        change_frame_id(IMU, "elsewhere"),
        ("imu/data: frame_id changes",),
    ),
    Fault(
        "imu_frame_id_empty",
        "the frame_id is lost",
        change_frame_id(IMU, ""),
        ("imu/data: frame_id changes",),
    ),
    Fault(
        "imu_frame_id_stray",
        "one message in ten has a frame_id that /tf_static places elsewhere",
        stray_frame_id(IMU, 0.1),
        ("imu/data: another frame_id|imu/data: frame_id changes", "no aligning anew"),
    ),
    # Stamps and gaps of the IMU.
    Fault(
        "imu_zero_stamps",
        "one stamp in ten is zero",
        change_stamps(IMU, lambda t, _: 0, 0.1),
        ("imu: zero stamp",),
    ),
    Fault(
        "imu_repeated_stamps",
        "every fourth stamp repeats the last",
        repeat_stamps,
        ("imu: repeated stamp",),
    ),
    Fault(
        "imu_reordered", "samples overtake each other", swap_in_time, ("imu: stamp out of order",)
    ),
    Fault(
        "imu_stray_future",
        "one stamp in a hundred is an hour ahead",
        change_stamps(IMU, lambda t, _: t + 3600 * 10**9, 0.01),
        ("imu: stamp jumps",),
    ),
    Fault(
        "imu_stray_past",
        "one stamp in a hundred is of yesterday",
        change_stamps(IMU, lambda t, _: t - 86_400 * 10**9, 0.01),
        ("imu: stamp jumps",),
    ),
    Fault(
        "imu_jitter",
        "stamps jitter by 2 ms",
        change_stamps(IMU, lambda t, f: t + round(f.rng.normal(0.0, 2e6))),
        ("no restart",),
    ),
    Fault(
        "imu_gap_short", "no samples for 0.3 s", lambda f: f.drop(IMU), ("imu: gaps bridged",), 0.3
    ),
    Fault(
        "imu_gap_long",
        "no samples for 3 s",
        lambda f: f.drop(IMU),
        ("restart: no IMU samples",),
        3.0,
    ),
    Fault(
        "imu_lossy", "a third of the samples is lost", lambda f: f.drop(IMU, 0.35), ("no restart",)
    ),
    Fault(
        "clock_forward",
        "all clocks jump an hour ahead",
        clock_jump(3600.0),
        ("restart: no IMU samples",),
        0.1,
        stamp_shift=3600.0,
    ),
    Fault(
        "clock_back",
        "all clocks jump an hour back",
        clock_jump(-3600.0),
        ("restart: the IMU's stamps went back",),
        0.1,
        stamp_shift=-3600.0,
    ),
    Fault(
        "bag_loop",
        "the bag is played in a loop",
        bag_loop,
        ("restart: the IMU's stamps went back",),
        0.1,
    ),
    # Fixes: values.
    Fault(
        "fix_nan",
        "latitude is NaN",
        change_fixes(with_attributes(latitude=NAN)),
        ("gnss: impossible position",),
    ),
    Fault(
        "fix_inf",
        "altitude is infinite",
        change_fixes(with_attributes(altitude=-INF)),
        ("gnss: impossible position",),
    ),
    Fault(
        "fix_scaled",
        "latitude in 1e-7 degrees",
        change_fixes(with_attributes(latitude=3.2e8)),
        ("gnss: impossible position",),
    ),
    Fault(
        "fix_zero",
        "latitude and longitude are zero",
        change_fixes(with_attributes(latitude=0.0, longitude=0.0, altitude=0.0)),
        ("gnss: impossible position",),
    ),
    Fault(
        "fix_pole",
        "latitude is 90",
        change_fixes(with_attributes(latitude=90.0)),
        ("gnss: impossible position",),
    ),
    Fault(
        "fix_status_none",
        "status is NO_FIX",
        change_fixes(with_status(-1)),
        ("gnss: no fix", "dead reckoning"),
    ),
    Fault(
        "fix_status_unknown",
        "status is UNKNOWN",
        change_fixes(with_status(-2)),
        ("gnss: no fix", "dead reckoning"),
    ),
    Fault(
        "fix_altitude_nan",
        "no altitude",
        change_fixes(with_attributes(altitude=NAN)),
        ("verdict dof 2",),
    ),
    Fault(
        "fix_outliers",
        "one fix in four is 50 m off",
        change_fixes(moved_north(lambda f: float(f.rng.choice([-50.0, 50.0]))), 0.25),
        ("innovation beyond the gate",),
    ),
    Fault(
        "fix_scattered",
        "every fix is somewhere else, 100 m off",
        change_fixes(moved_north(lambda f: f.rng.normal(0.0, 100.0))),
        ("innovation beyond the gate",),
    ),
    Fault(
        "fix_shift",
        "all fixes are 30 m off, and then right again",
        change_fixes(moved_north(lambda f: 30.0)),
        ("gnss: state opened",),
    ),
    Fault(
        "fix_drift",
        "fixes drift off by 2 m/s, and then are right again",
        drift,
        ("innovation beyond the gate",),
    ),
    Fault(
        "fix_frozen",
        "the same position again and again",
        fix_frozen,
        ("gnss: same position while moving",),
    ),
    Fault(
        "fix_first_wild",
        "the very first fix is 111 km off",
        first_fix_wild,
        ("restart: the fixes jumped before the heading was known",),
        0.1,
    ),
    Fault(
        "fix_frame_id",
        "the frame_id changes",
        change_frame_id(FIX, "elsewhere"),
        ("gnss/fix: frame_id changes",),
    ),
    Fault(
        "fix_frame_id_stray",
        "one fix in five has a frame_id that /tf_static places elsewhere",
        stray_frame_id(FIX, 0.2),
        ("gnss/fix: another frame_id|gnss/fix: frame_id changes", "no aligning anew"),
    ),
    # Fixes: covariances.
    Fault(
        "cov_unknown",
        "covariance type is unknown",
        change_fixes(with_covariance(np.eye(3), 0)),
        ("gnss: covariance",),
    ),
    Fault(
        "cov_zero",
        "covariance is zero",
        change_fixes(with_covariance(np.zeros((3, 3)))),
        ("gnss: covariance",),
    ),
    Fault(
        "cov_negative",
        "variances are negative",
        change_fixes(with_covariance(-np.eye(3), DIAGONAL)),
        ("gnss: covariance",),
    ),
    Fault(
        "cov_nan",
        "covariance is NaN",
        change_fixes(with_covariance(np.full((3, 3), NAN))),
        ("gnss: covariance",),
    ),
    Fault(
        "cov_indefinite",
        "covariance is not positive definite",
        change_fixes(with_covariance(INDEFINITE)),
        ("gnss: covariance",),
    ),
    Fault(
        "cov_tiny",
        "a nanometre is claimed",
        change_fixes(with_covariance(1e-18 * np.eye(3))),
        ("verdict sigma_e 0.01",),
    ),
    Fault(
        "cov_tight",
        "three millimetres are claimed of noise of a decimetre",
        change_fixes(with_covariance(9e-6 * np.eye(3))),
        ("verdict sigma_e 0.01",),
    ),
    Fault(
        "cov_huge",
        "a kilometre is claimed",
        change_fixes(with_covariance(1e6 * np.eye(3))),
        ("gnss: poor fix", "dead reckoning"),
    ),
    # Fixes: time.
    Fault("fix_outage", "no fixes for 10 s", lambda f: f.drop(FIX), ("dead reckoning",), 10.0),
    Fault("fix_sparse", "most fixes are lost", lambda f: f.drop(FIX, 0.8), ("no restart",)),
    Fault("fix_repeated", "every fix comes twice", fix_repeated, ("gnss: repeated stamp",)),
    Fault(
        "fix_zero_stamp",
        "stamps are zero",
        change_stamps(FIX, lambda t, _: 0),
        ("gnss: zero stamp",),
    ),
    Fault(
        "fix_future",
        "stamps are a minute ahead",
        change_stamps(FIX, lambda t, _: t + 60 * 10**9),
        ("gnss: stamped ahead of the IMU",),
    ),
    Fault(
        "fix_past",
        "stamps are a minute behind",
        change_stamps(FIX, lambda t, _: t - 60 * 10**9),
        ("gnss: too old",),
    ),
    Fault(
        "fix_late",
        "fixes arrive 0.3 s late",
        fix_late(lambda f: 0.3),
        ("verdict age 0.3|verdict age 0.2",),
    ),
    Fault(
        "fix_late_reordered",
        "fixes arrive up to 0.5 s late and overtake each other",
        fix_late(lambda f: f.rng.uniform(0.0, 0.5)),
        ("verdict age 0.4|verdict age 0.3",),
    ),
    Fault("fix_burst", "fixes are held back and come in bursts", fix_burst, ("verdict age 0.6",)),
    Fault("fix_too_late", "fixes arrive 2 s late", fix_late(lambda f: 2.0), ("gnss: too old",)),
    # Other input.
    Fault(
        "velocity_nan",
        "a velocity that is NaN",
        insert_velocity(lambda f: (NAN, 0.0, 0.0)),
        ("velocity: not finite",),
    ),
    Fault(
        "velocity_absurd",
        "a velocity of 1e6 m/s",
        insert_velocity(lambda f: (1e6, 0.0, 0.0)),
        ("velocity: absurd",),
    ),
    Fault(
        "velocity_wrong",
        "a velocity that is 30 m/s off, claiming 0.05 m/s",
        insert_velocity(lambda f: (30.0, 0.0, 0.0)),
        ("innovation beyond the gate",),
    ),
    Fault(
        "pose_no_rotation",
        "an initialpose whose quaternion is zero",
        insert_pose((0.0, 0.0, 0.0, 0.0)),
        ("initialpose: no orientation",),
        0.1,
    ),
    # From the start.
    Fault("start_in_flight", "the IMU comes up in flight", late_start(IMU), ("no restart",), 0.1),
    Fault(
        "start_without_fixes",
        "the receiver finds its first fix in flight",
        late_start(FIX),
        ("waiting for GNSS",),
        0.1,
    ),
    Fault(
        "always_in_g",
        "accelerations in g from the start",
        lambda f: always(f, change_force(lambda force, _: force / 9.80665)),
        ("the unit seems to be g",),
        silent=True,
    ),
    Fault(
        "no_fixes_at_all",
        "not one fix is valid",
        lambda f: always(f, change_fixes(with_status(-1))),
        ("waiting for GNSS",),
        silent=True,
    ),
)
