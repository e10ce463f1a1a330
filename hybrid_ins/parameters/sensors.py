"""Parameters of the IMU and of GNSS."""

from __future__ import annotations

from typing import Any

from hybrid_ins.parameters.parameter import Parameter

_METRES: dict[str, Any] = {"unit": "m", "low": -1000.0, "high": 1000.0}

IMU = (
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
        "imu.scale_std",
        0.005,
        "Standard deviation of the errors of the scale factors of accelerometers and gyroscopes, "
        "relative; axes are off their directions by half of it [rad]. The motion with fixes shows "
        "them; outages are corrected by what it has shown, and the rest makes their covariance "
        "grow; 0: not at all",
        low=0.0,
        high=0.1,
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
        2.0,
        "After a longer gap between IMU samples the filter aligns again",
        unit="s",
        low=0.01,
        high=60.0,
    ),
)

GNSS = (
    Parameter(
        "gnss.antenna_position",
        [0.0, 0.0, 0.0],
        "Position of the antenna in base_frame (forward, left, up)",
        unit="m",
        low=-200.0,
        high=200.0,
    ),
    Parameter(
        "gnss.antenna_position_std",
        [0.0, 0.0, 0.0],
        "Standard deviation of that position (forward, left, up), as ins_calibrate writes it: the "
        "covariance of the odometry contains it until the motion has shown the place better; 0: "
        "exact",
        unit="m",
        low=0.0,
        high=20.0,
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
        "gnss.time_offset.std",
        0.0,
        "Standard deviation of gnss.time_offset.value, as ins_calibrate writes it. 0: not known; "
        "gnss.time_offset.estimate then also searches for an offset of tenths of a second",
        unit="s",
        low=0.0,
        high=0.1,
        runtime=True,
    ),
    Parameter(
        "gnss.time_offset.estimate",
        True,
        "Estimate the clock offset and its drift while running and correct them; published "
        "covariances include what is not known of them. Until motion has shown the offset, up to "
        "156 filters run beside: on a slow computer give gnss.time_offset.value with its std, "
        "which ins_calibrate writes. If false, a wrong offset is only reported",
        runtime=True,
    ),
    Parameter(
        "gnss.time_offset.drift",
        0.0,
        "Rate at which the clock offset changes, as ins_calibrate writes it. Where it is not 0, "
        "gnss.time_offset.value is the offset of the first fix",
        unit="ppm",
        low=-10000.0,
        high=10000.0,
    ),
    Parameter(
        "gnss.time_offset.drift_std",
        100.0,
        "Standard deviation of gnss.time_offset.drift",
        unit="ppm",
        low=1.0,
        high=10000.0,
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
        "gnss.position_scatter",
        1.0,
        "Scatter of positions from fix to fix, relative to the standard deviations they claim, as "
        "ins_calibrate finds it. Below 1 the rest of what they claim is a slow error: it does not "
        "weigh fixes less, and is part of the published covariance. Learned while running where "
        "noise.innovation_scale is true",
        low=0.2,
        high=10.0,
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
        "Standard deviation of GNSS velocities whose covariance is unusable or unknown, of each "
        "horizontal component; of the vertical one it is twice that",
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
        "gnss.max_speed",
        515.0,
        "Greatest plausible speed of the vehicle: a fix that it could not have reached from the "
        "one before is rejected, until fixes have agreed with it for gnss.patience; so is a "
        "greater velocity. The default is the speed beyond which civil receivers give no fixes",
        unit="m/s",
        low=0.1,
        high=1e5,
        runtime=True,
    ),
    Parameter(
        "gnss.max_delay",
        1.0,
        "Fixes that arrive later than this after their stamp are rejected; earlier ones are fused "
        "at their stamp. A negative gnss.time_offset.value is no delay",
        unit="s",
        low=0.0,
        high=5.0,
    ),
)
