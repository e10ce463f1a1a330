"""Parameters of the vehicle, of aiding beside GNSS, and of what is claimed of the state."""

from __future__ import annotations

from typing import Any

from hybrid_ins.parameters.parameter import Parameter

_METRES: dict[str, Any] = {"unit": "m", "low": -1000.0, "high": 1000.0}

VEHICLE = (
    Parameter(
        "vehicle.kind",
        "auto",
        "Whether the vehicle moves along its nose, which constrains the velocity in outages of "
        "GNSS, and the heading where fixes do not show it. ground: it does, until its motion shows "
        "otherwise, then as auto; auto: once its motion has shown it, and as long as it does; "
        "fixed_wing: it does against the air; others: it does not",
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
    Parameter(
        "vehicle.slip_model",
        "slip",
        "Network that reads that standard deviation from the last second of IMU samples in "
        "outages, within 0.1 to 10 times vehicle.slip_std: slip, or the path of an .onnx file; "
        "empty: vehicle.slip_std is used",
        longest=4000,
    ),
)

AIDING = (
    Parameter(
        "aiding.velocity_position",
        [0.0, 0.0, 0.0],
        "Point in base_frame (forward, left, up) whose velocity is measured on aiding/velocity and "
        "aiding/odometry",
        **_METRES,
    ),
    Parameter(
        "aiding.velocity_position_std",
        [1.0],
        "Standard deviation of that point's position: one number for all axes, or three (forward, "
        "left, up); the motion determines it",
        unit="m",
        lengths=(1, 3),
        low=1e-4,
        high=100.0,
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
        "covariance is unknown or the driver leaves that of x at 0",
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

VALIDITY = (
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
