"""Every parameter, declared once, in the order in which a user needs them."""

from __future__ import annotations

from typing import Any

from hybrid_ins.parameter import Parameter

_METRES: dict[str, Any] = {"unit": "m", "low": -1000.0, "high": 1000.0}
_ACCELERATION_VARIANCE = "(m/s²)²"
_RATE_VARIANCE = "(rad/s)²"
_PAPER_MODES = ("cq1", "cq2", "cq3", "innovation", "innovation_literal")

_FRAMES = (
    Parameter("map_frame", "map", "Frame of odometry: east-north-up at the datum (REP-105)"),
    Parameter("odom_frame", "odom", "Frame of odometry/local, which is continuous (REP-105)"),
    Parameter("base_frame", "base_link", "Frame whose pose and twist are published"),
    Parameter(
        "datum",
        [],
        "Origin of the map: latitude [deg], longitude [deg], ellipsoidal height [m]; empty: the "
        "first accepted fix",
        lengths=(0, 3),
        low=-12000.0,
        high=1e7,
    ),
    Parameter(
        "publish_tf", True, "Publish the transforms map→odom→base_frame, where tf2 is installed"
    ),
    Parameter(
        "use_tf_static",
        True,
        "Use /tf_static for the place of a sensor where imu.position and imu.mount_rpy, or "
        "gnss.antenna_position, are all zero",
    ),
    Parameter(
        "use_receive_time",
        False,
        "Use the time of arrival instead of the messages' stamps: only for drivers that do not "
        "stamp, because it costs accuracy",
    ),
)

_IMU = (
    Parameter(
        "imu.position",
        [0.0, 0.0, 0.0],
        "Position of the IMU in base_frame (forward, left, up)",
        **_METRES,
    ),
    Parameter(
        "imu.mount_rpy",
        [0.0, 0.0, 0.0],
        "Roll, pitch and yaw that rotate the axes of base_frame into those of the IMU",
        unit="rad",
        low=-6.3,
        high=6.3,
    ),
    Parameter(
        "imu.accelerometer_bias",
        [0.0, 0.0, 0.0],
        "Accelerometer bias at the start (forward, left, up), as published on imu/bias",
        unit="m/s²",
        low=-10.0,
        high=10.0,
    ),
    Parameter(
        "imu.accelerometer_bias_std",
        [0.3],
        "Standard deviation of the accelerometer bias at the start: one number for all axes, or "
        "three (forward, left, up)",
        unit="m/s²",
        lengths=(1, 3),
        low=1e-6,
        high=10.0,
    ),
    Parameter(
        "imu.gyroscope_bias",
        [0.0, 0.0, 0.0],
        "Gyroscope bias at the start (forward, left, up), as published on imu/bias",
        unit="rad/s",
        low=-1.0,
        high=1.0,
    ),
    Parameter(
        "imu.gyroscope_bias_std",
        [0.01],
        "Standard deviation of the gyroscope bias at the start: one number for all axes, or three "
        "(forward, left, up)",
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
        "Samples with a greater specific force on any axis are rejected as faulty",
        unit="m/s²",
        low=20.0,
        high=1e5,
    ),
    Parameter(
        "imu.max_angular_rate",
        80.0,
        "Samples with a greater angular rate on any axis are rejected as faulty",
        unit="rad/s",
        low=1.0,
        high=1e4,
    ),
    Parameter(
        "imu.zero_updates",
        True,
        "Use zero velocity and zero rotation as measurements while the vehicle stands, as far as "
        "IMU and estimated speed show it",
    ),
    Parameter(
        "imu.max_gap",
        0.5,
        "After a longer gap between IMU samples the filter aligns again",
        unit="s",
        low=0.01,
        high=60.0,
    ),
)

_GNSS = (
    Parameter(
        "gnss.antenna_position",
        [0.0, 0.0, 0.0],
        "Position of the antenna in base_frame (forward, left, up)",
        **_METRES,
    ),
    Parameter(
        "gnss.time_offset.value",
        0.0,
        "Added to the stamps of fixes to express them in the IMU's clock",
        unit="s",
        low=-10.0,
        high=10.0,
        runtime=True,
    ),
    Parameter(
        "gnss.time_offset.estimate",
        False,
        "Estimate the clock offset while running and correct it; if false, a wrong offset is only "
        "reported",
        runtime=True,
    ),
    Parameter(
        "gnss.position_std_min",
        0.01,
        "Lower bound of a fix's standard deviations: receivers state millimetres that clock offset "
        "and lever arm do not allow",
        unit="m",
        low=0.0,
        high=100.0,
        runtime=True,
    ),
    Parameter(
        "gnss.position_std_max",
        100.0,
        "Fixes with a greater horizontal standard deviation are rejected",
        unit="m",
        low=0.01,
        high=1e5,
        runtime=True,
    ),
    Parameter(
        "gnss.position_std_default",
        [3.0, 3.0, 6.0],
        "Standard deviations (east, north, up) of fixes whose covariance is unusable or unknown",
        unit="m",
        low=1e-3,
        high=1000.0,
    ),
    Parameter(
        "gnss.velocity_std_min",
        0.02,
        "Lower bound of the standard deviations of a GNSS velocity",
        unit="m/s",
        low=0.0,
        high=100.0,
        runtime=True,
    ),
    Parameter(
        "gnss.velocity_std_default",
        0.2,
        "Standard deviation of GNSS velocities whose covariance is unusable or unknown",
        unit="m/s",
        low=1e-3,
        high=100.0,
    ),
    Parameter(
        "gnss.gate_probability",
        0.9999,
        "Probability that the innovation of a valid fix is small enough to agree with the state; "
        "others are weighted down, and prove the state wrong after gnss.patience",
        low=0.5,
        high=1.0 - 1e-12,
        runtime=True,
    ),
    Parameter(
        "gnss.patience",
        3.0,
        "After this time of consecutive rejections of fixes that agree with each other, the filter "
        "re-converges to the fixes",
        unit="s",
        low=0.0,
        high=3600.0,
        runtime=True,
    ),
    Parameter(
        "gnss.max_delay",
        1.0,
        "Fixes that arrive later than this after their stamp are rejected; earlier ones are fused "
        "at their stamp",
        unit="s",
        low=0.0,
        high=5.0,
    ),
)

_ALIGNMENT = (
    Parameter(
        "alignment.heading_source",
        "auto",
        "Source of the initial heading. auto, motion: any motion that shows it; course: the "
        "course over ground, for vehicles that move where they point; parameter: alignment.yaw; "
        "imu: the orientation in the IMU's messages",
        choices=("auto", "motion", "parameter", "imu", "course"),
    ),
    Parameter(
        "alignment.yaw",
        0.0,
        "Initial heading of base_frame in map for heading_source parameter: 0 is east, "
        "counter-clockwise is positive",
        unit="rad",
        low=-6.3,
        high=6.3,
    ),
    Parameter(
        "alignment.yaw_std",
        0.1,
        "Standard deviation of an initial heading from parameter or IMU",
        unit="rad",
        low=1e-4,
        high=3.2,
    ),
    Parameter(
        "alignment.course_min_speed",
        1.0,
        "Lowest speed at which the course over ground is used as the heading",
        unit="m/s",
        low=0.1,
        high=50.0,
    ),
    Parameter(
        "alignment.window",
        1.0,
        "Duration of the IMU data that levelling averages",
        unit="s",
        low=0.05,
        high=5.0,
    ),
)

_NOISE = (
    Parameter(
        "noise.mode",
        "learned",
        "Source of the process noise. learned: a regressor on the latest IMU samples; constant: "
        "noise.q_accelerometer and noise.q_gyroscope",
        choices=("learned", "constant", *_PAPER_MODES),
        experiment_choices=_PAPER_MODES,
        runtime=True,
    ),
    Parameter(
        "noise.model",
        "plateau",
        "Regressor of mode learned: plateau, spectral (needs no onnxruntime), paper (for "
        "comparison), or the path of an .onnx file",
        longest=4000,
        runtime=True,
    ),
    Parameter(
        "noise.refresh_period",
        0.2,
        "Interval between two runs of the regressor",
        unit="s",
        low=0.01,
        high=10.0,
        runtime=True,
    ),
    Parameter(
        "noise.innovation_scale",
        True,
        "In mode learned, scale the process noise and the covariance of fixes by factors that the "
        "innovations show: up as far as needed, down by 30 at most",
        runtime=True,
    ),
    Parameter(
        "noise.q_accelerometer",
        4e-4,
        "Variance of the accelerometer's noise per sample, in mode constant and when the regressor "
        "has no valid estimate",
        unit=_ACCELERATION_VARIANCE,
        low=1e-12,
        high=1e4,
        runtime=True,
    ),
    Parameter(
        "noise.q_accelerometer_min",
        1e-8,
        "Lower bound of the estimated variance of the accelerometer's noise",
        unit=_ACCELERATION_VARIANCE,
        low=0.0,
        high=1e4,
        runtime=True,
    ),
    Parameter(
        "noise.q_accelerometer_max",
        1e3,
        "Greater estimates of the variance of the accelerometer's noise are rejected",
        unit=_ACCELERATION_VARIANCE,
        low=1e-12,
        high=1e6,
        runtime=True,
    ),
    Parameter(
        "noise.background_accelerometer",
        [0.0, 0.0, 0.0],
        "Level that the regressor exceeds for 1 % of the time in this vehicle's ordinary motion "
        "(forward, left, up), as ins_calibrate finds it. Below it the noise is "
        "noise.q_accelerometer; only what exceeds it is added. 0: unknown, the estimate is used as "
        "it is",
        unit=_ACCELERATION_VARIANCE,
        low=0.0,
        high=1e4,
        runtime=True,
    ),
    Parameter(
        "noise.q_gyroscope",
        4e-6,
        "Variance of the gyroscope's noise per sample, in mode constant and when the regressor has "
        "no valid estimate",
        unit=_RATE_VARIANCE,
        low=1e-14,
        high=1e2,
        runtime=True,
    ),
    Parameter(
        "noise.q_gyroscope_min",
        1e-10,
        "Lower bound of the estimated variance of the gyroscope's noise",
        unit=_RATE_VARIANCE,
        low=0.0,
        high=1e2,
        runtime=True,
    ),
    Parameter(
        "noise.q_gyroscope_max",
        10.0,
        "Greater estimates of the variance of the gyroscope's noise are rejected",
        unit=_RATE_VARIANCE,
        low=1e-14,
        high=1e4,
        runtime=True,
    ),
    Parameter(
        "noise.background_gyroscope",
        [0.0, 0.0, 0.0],
        "As noise.background_accelerometer, for the gyroscope",
        unit=_RATE_VARIANCE,
        low=0.0,
        high=1e2,
        runtime=True,
    ),
    Parameter(
        "noise.innovation_window",
        3,
        "Number of innovations averaged in mode innovation, ξ in the paper",
        low=1,
        high=100,
        runtime=True,
        experiment=True,
    ),
    Parameter(
        "noise.units",
        "consistent",
        "consistent: Qc = q·Δt; paper: Qc = q, as the paper prints it",
        choices=("consistent", "paper"),
        experiment_choices=("paper",),
        runtime=True,
        experiment=True,
    ),
)

_VEHICLE = (
    Parameter(
        "vehicle.kind",
        "auto",
        "Whether the vehicle moves along its nose, which constrains the velocity in outages of "
        "GNSS. ground: it does, until its motion shows otherwise; auto: once its motion has shown "
        "it, and as long as it does; others: it does not",
        choices=("auto", "ground", "fixed_wing", "multirotor", "other"),
    ),
    Parameter(
        "vehicle.axle_position",
        [0.0, 0.0, 0.0],
        "Point that does not slip sideways, the centre of the rear axle, in base_frame (forward, "
        "left, up)",
        **_METRES,
    ),
    Parameter(
        "vehicle.axle_position_std",
        1.5,
        "Standard deviation of that point's position along the nose; the motion determines it",
        unit="m",
        low=1e-3,
        high=100.0,
    ),
    Parameter(
        "vehicle.nose",
        [0.0, 0.0],
        "Direction of the nose in base_frame: yaw to the left, pitch up",
        unit="rad",
        lengths=(2,),
        low=-6.3,
        high=6.3,
    ),
    Parameter(
        "vehicle.nose_std",
        0.05,
        "Standard deviation of both; the motion determines them",
        unit="rad",
        low=1e-5,
        high=3.2,
    ),
    Parameter(
        "vehicle.slip_std",
        [0.1, 0.1],
        "Standard deviation of that point's velocity across the nose (left, up): slip of the "
        "tyres, travel of the springs",
        unit="m/s",
        lengths=(2,),
        low=1e-3,
        high=10.0,
    ),
)

_AIDING = (
    Parameter(
        "aiding.velocity_position",
        [0.0, 0.0, 0.0],
        "Point in base_frame (forward, left, up) whose velocity is measured on aiding/velocity and "
        "aiding/odometry",
        **_METRES,
    ),
    Parameter(
        "aiding.velocity_scale",
        1.0,
        "Factor from these readings to the velocity; the motion with fixes determines it",
        low=0.01,
        high=100.0,
    ),
    Parameter(
        "aiding.velocity_scale_std",
        0.03,
        "Standard deviation of that factor",
        low=1e-5,
        high=10.0,
    ),
    Parameter(
        "aiding.velocity_std_min",
        0.05,
        "Lower bound of the standard deviations of these readings, and their value where the "
        "covariance is unknown",
        unit="m/s",
        low=1e-3,
        high=100.0,
    ),
    Parameter(
        "aiding.heading_std_min",
        0.02,
        "The same for the heading on aiding/heading",
        unit="rad",
        low=1e-4,
        high=3.2,
    ),
    Parameter(
        "aiding.height_std_min",
        0.3,
        "The same for the height by the air pressure on aiding/pressure",
        unit="m",
        low=1e-3,
        high=1000.0,
    ),
)

_VALIDITY = (
    Parameter(
        "validity.position_std_max",
        10.0,
        "Greatest standard deviation of the horizontal position that is not reported as lost on "
        "validity",
        unit="m",
        low=1e-3,
        high=1e6,
    ),
    Parameter(
        "validity.velocity_std_max",
        1.0,
        "The same for the horizontal velocity",
        unit="m/s",
        low=1e-3,
        high=1e4,
    ),
    Parameter(
        "validity.heading_std_max",
        0.2,
        "The same for the heading",
        unit="rad",
        low=1e-4,
        high=3.2,
    ),
)

_OUTPUT = (
    Parameter(
        "state_file",
        "",
        "File that keeps biases, clock offset and pose for the next start; empty: none",
        longest=4000,
    ),
    Parameter(
        "autostart",
        True,
        "Configure and activate at the start; false: wait for a lifecycle manager to do so",
    ),
    Parameter(
        "odometry_rate",
        0.0,
        "Rate of odometry and odometry/local; 0: with every IMU sample",
        unit="Hz",
        low=0.01,
        high=10000.0,
        or_zero=True,
        runtime=True,
    ),
    Parameter(
        "covariance_interval",
        0.01,
        "Interval of the covariance propagation, which also runs before every update; 0: with "
        "every IMU sample",
        unit="s",
        low=0.0,
        high=0.05,
    ),
)

PARAMETERS: dict[str, Parameter] = {
    p.name: p
    for p in (
        *_FRAMES,
        *_OUTPUT,
        *_IMU,
        *_GNSS,
        *_ALIGNMENT,
        *_VEHICLE,
        *_AIDING,
        *_VALIDITY,
        *_NOISE,
    )
}
