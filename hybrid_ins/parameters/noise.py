"""Parameters of the process noise."""

from __future__ import annotations

from hybrid_ins.parameters.parameter import Parameter

_ACCELERATION_VARIANCE = "(m/s²)²"
_RATE_VARIANCE = "(rad/s)²"
_PAPER_MODES = ("cq1", "cq2", "cq3", "innovation", "innovation_literal")

NOISE = (
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
        "Variance of the gyroscope's noise per sample, in mode constant, below 100 Hz, and when "
        "the regressor has no valid estimate",
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
