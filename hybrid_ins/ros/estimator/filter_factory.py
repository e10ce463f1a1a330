"""
From parameters to the parts of a filter: process noise, noise model, gate, settings.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.alignment.alignment import AlignmentSettings
from hybrid_ins.core.filter.events import NoiseChange, SettingsChange
from hybrid_ins.core.filter.filter_noise import FilterNoise
from hybrid_ins.core.filter.filter_settings import FilterSettings
from hybrid_ins.core.filter.ins_filter import InsFilter
from hybrid_ins.core.fix_checks.fix_speed import SpeedCheck
from hybrid_ins.core.navigator.navigator import Navigator
from hybrid_ins.core.noise.innovation import InnovationNoise
from hybrid_ins.core.noise.multiple_model import NoiseMultipleModelBank
from hybrid_ins.core.noise.process_noise import (
    PAPER_CONSTANTS,
    ConstantNoise,
    LearnedNoise,
    NoiseModel,
    ProcessNoise,
)
from hybrid_ins.core.sensor_errors.clock_prior import ClockDrift, ClockPrior
from hybrid_ins.core.smoothing.forward_record import RunRecord
from hybrid_ins.core.update import chi_square
from hybrid_ins.core.update.gate import Gate
from hybrid_ins.ros.messages.conversions import clock_drift, first_biases, yaw_ned_from_enu

Array = NDArray[np.float64]

GATE = ("gnss.gate_probability", "gnss.patience")  # parameters of the gate


class FilterFactory:
    """
    Builds filter parts; see `hybrid_ins.core.navigator.phases.FilterParts`.

    Parameters
    ----------
    values : mapping
        Checked parameters. Parts that are made after `change` follow the changed values.
    keep_record : bool
        The filters keep a record for a smoother.
    """

    def __init__(self, values: Mapping[str, Any], keep_record: bool = False) -> None:
        self._values = dict(values)
        self.settings = FilterSettings(
            values["covariance_interval"],
            values["gnss.max_delay"],
            consider_clock=values["gnss.time_offset.estimate"],
            keep_record=keep_record,
            position_scatter=values["gnss.position_scatter"],
            learn_scatter=self._adapts(),
            scale_std=values["imu.scale_std"],
        )
        given = values["gnss.time_offset.value"]
        prior = ClockPrior(given, values["gnss.time_offset.std"])
        self.set_clock_offset(given, prior, clock_drift(values))
        self.mount = np.eye(3)
        self.speed_check = SpeedCheck(values["gnss.max_speed"], values["gnss.patience"])

    def change(self, changes: Mapping[str, Any]) -> None:
        """Use checked values of run-time parameters from now on."""
        self._values.update(changes)
        consider = self._values["gnss.time_offset.estimate"]
        self.settings = replace(
            self.settings, consider_clock=consider, learn_scatter=self._adapts()
        )
        self.speed_check.max_speed = self._values["gnss.max_speed"]
        self.speed_check.patience = self._values["gnss.patience"]

    def place_sensors(
        self, mount: Array, lever_b: Array, lever_std: Array, is_placed: bool
    ) -> None:
        """
        Note how the IMU lies, and where the antenna is relative to it [m], b, shape (3,).

        ``mount``, shape (3, 3), leads from the IMU's own axes to b. The standard deviation is zero
        where the antenna was not found from motion; where it is not placed, nobody has said where
        it is.
        """
        self.mount = mount
        self.settings = replace(
            self.settings, lever_b=lever_b, lever_std=lever_std, antenna_is_placed=is_placed
        )

    def set_clock_offset(self, offset: float, prior: ClockPrior, drift: ClockDrift) -> None:
        """
        Note that ``offset`` [s] is added to the stamps of fixes, and the priors of what should be.

        They may be as late after their own stamps as before.
        """
        max_delay = self._values["gnss.max_delay"] + max(0.0, -offset)
        missing = prior._replace(mean=prior.mean - offset)
        self.settings = replace(
            self.settings, max_delay=max_delay, clock_prior=missing, clock_drift=drift
        )

    def navigator(self, record: RunRecord | None) -> Navigator:
        """Return a navigator whose filters are made of these parts; it fills the record."""
        values = self._values
        return Navigator(
            self.alignment(), self, values["imu.max_gap"], values["imu.zero_updates"], record
        )

    def change_running(self, running: InsFilter, changes: Iterable[str] = ()) -> None:
        """Give a filter that runs the settings; gate and noise where parameters of them changed."""
        running.change_settings(self.settings)
        if any(name in GATE for name in changes):
            running.submit(SettingsChange(running.t_ns, gate=self.gate()))
        if any(name.startswith("noise.") or name.endswith("_bias_walk") for name in changes):
            noise = self.noise(running.noise.process.period)
            running.submit(NoiseChange(running.t_ns, noise))

    def alignment(self) -> AlignmentSettings:
        """Return what alignment is given."""
        values = self._values
        return AlignmentSettings(
            values["alignment.heading_source"],
            yaw_ned_from_enu(values["alignment.yaw"]),
            values["alignment.yaw_std"],
            values["alignment.course_min_speed"],
            values["alignment.window"],
            *first_biases(values),
        )

    def noise(self, period: float) -> FilterNoise:
        """Return the noise of a new filter for an IMU's sample period [s]."""
        process = self._process(period)
        factors = NoiseMultipleModelBank() if self._adapts() else None
        return FilterNoise(self._model(process), process, factors)

    def _adapts(self) -> bool:
        """Return whether noise is learned from the innovations, too."""
        values = self._values
        return bool(values["noise.mode"] == "learned" and values["noise.innovation_scale"])

    def _process(self, period: float) -> ProcessNoise:
        walk_a = self._values["imu.accelerometer_bias_walk"]
        walk_g = self._values["imu.gyroscope_bias_walk"]
        return ProcessNoise(
            np.array([walk_a**2] * 3 + [walk_g**2] * 3),
            period,
            self._values["noise.units"] == "consistent",
        )

    def _model(self, process: ProcessNoise) -> NoiseModel:
        values, mode = self._values, self._values["noise.mode"]
        constant = np.repeat((values["noise.q_accelerometer"], values["noise.q_gyroscope"]), 3)
        if mode in PAPER_CONSTANTS:
            return ConstantNoise(np.repeat(PAPER_CONSTANTS[mode], 3))
        if mode == "learned":
            background = (
                values["noise.background_accelerometer"],
                values["noise.background_gyroscope"],
            )
            return LearnedNoise(constant, np.concatenate(background))
        if mode in ("innovation", "innovation_literal"):
            floor = (values["noise.q_accelerometer_min"], values["noise.q_gyroscope_min"])
            return InnovationNoise(
                constant,
                np.repeat(floor, 3),
                values["noise.innovation_window"],
                process,
                mode == "innovation_literal",
            )
        return ConstantNoise(constant)

    def gate(self) -> Gate:
        """Return a fresh gate."""
        probability = self._values["gnss.gate_probability"]
        return Gate(
            {m: chi_square.quantile(probability, m) for m in (1, 2, 3, 6)},
            self._values["gnss.patience"],
        )
