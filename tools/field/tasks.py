"""The parts of the field experiment: a flight flown, a session calibrated, a run simulated."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_ins import parameters
from hybrid_ins.calibration.calibrate import calibrate
from hybrid_ins.calibration.clock import IDENTIFIED_OFFSET
from hybrid_ins.calibration.derived import next_biases
from hybrid_ins.calibration.filter_pass import FilterPass
from hybrid_ins.calibration.fit import Fit
from hybrid_ins.errors import InputError
from hybrid_ins.ros.messages.conversions import FLIP
from hybrid_ins.simulation.sensors import ImuErrors
from tools.field.flights import Fixes, Flight, as_recording, fixes, fly, load
from tools.field.methods import (
    NO_SCALE,
    ORACLE,
    OURS,
)
from tools.paper import montecarlo
from tools.paper.montecarlo import Method
from tools.paper.runs import Scenario, draw

INJECTED = (3.0, 0.1)  # m/s2, rad/s: standard deviation of the injected noise, per sample
BLOCK = 5.0  # s of quiet, then of injected noise
TRUTH = np.array([0.03, 0.03, 0.04])  # m, of the reference taken for fixes
OUTAGE = 10.0  # s
MISFITS = {
    "right model": ImuErrors(),
    "scale factors 1 %": ImuErrors(accelerometer_scale=0.01, gyroscope_scale=0.01),
    "mount 2°": ImuErrors(mount_rpy=np.radians([2.0, -2.0, 2.0])),
    "g-sensitivity 1e-3": ImuErrors(g_sensitivity=1e-3),
    "coloured noise": ImuErrors(
        accelerometer_coloured_std=0.3, gyroscope_coloured_std=0.02, coloured_time=0.5
    ),
}
HINDSIGHT = tuple(
    Method(f"{a:g}, {g:g}", "constant", (4e-4 * a, 4e-6 * g))
    for a, g in (
        (1, 1),
        (10, 1),
        (100, 1),
        (1e3, 1),
        (1e4, 1),
        (1, 10),
        (1, 100),
        (1, 1e3),
        (10, 10),
        (100, 10),
        (10, 100),
        (100, 100),
        (1e3, 100),
        (1e3, 1e3),
        (1e4, 1e2),
    )
)


@dataclass(frozen=True)
class Task:
    """One flight with one IMU and one draw of fixes, under some methods."""

    condition: str
    number: int
    imu: int
    seed: int
    rate: float
    values: dict[str, Any]  # calibrated parameters
    methods: dict[str, dict[str, Any]]
    outage: float | None = None  # s, start
    injected: bool = False
    heading: float | None = 0.0  # rad


Row = dict[str, Any]


def inject(flight: Flight, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the flight's readings with strong white noise in every second block."""
    rng = np.random.default_rng([seed, int(flight.name[1:]), flight.imu, 7])
    t = (flight.stamp_ns - flight.stamp_ns[0]) * 1e-9
    rough = ((t // BLOCK).astype(int) % 2 == 1)[:, None]
    force, rate = (
        readings + rough * std * rng.standard_normal(readings.shape)
        for readings, std in zip((flight.force, flight.rate), INJECTED, strict=True)
    )
    return force, rate


def injected_levels(flight: Flight, values: Mapping[str, Any]) -> Callable[[int], np.ndarray]:
    """Return what gives the true levels at a stamp [ns]: the calibrated ones, and the injected."""
    quiet = np.repeat([values["noise.q_accelerometer"], values["noise.q_gyroscope"]], 3)
    rough = quiet + np.repeat(np.square(INJECTED), 3)

    def levels(t_ns: int) -> np.ndarray:
        return rough if (t_ns - flight.stamp_ns[0]) * 1e-9 // BLOCK % 2 == 1 else quiet

    return levels


def fly_task(data: Path, task: Task) -> list[Row]:
    """Fly a task with all its methods."""
    flight = load(data, task.number, task.imu)
    outages = [] if task.outage is None else [(task.outage, OUTAGE)]
    aid = fixes(flight, task.rate, task.seed, outages)
    force, rate = inject(flight, task.seed) if task.injected else (None, None)
    rows = []
    for name, overrides in task.methods.items():
        values = parameters.check_all({**task.values, **overrides})
        row: Row = {
            "condition": task.condition,
            "rate": task.rate,
            "flight": flight.name,
            "session": flight.session,
            "imu": task.imu,
            "seed": task.seed,
            "method": name,
        }
        try:
            flown = fly(
                flight,
                aid,
                values,
                offset=values["gnss.time_offset.value"],
                heading=task.heading,
                force=force,
                rate=rate,
                told=injected_levels(flight, values) if name == ORACLE else None,
            )
        except InputError:
            rows.append(
                {
                    **row,
                    "prmse": np.inf,
                    "pmae": np.inf,
                    "nees": np.inf,
                    "nis": np.inf,
                    "end": np.inf,
                    "offset_20": np.nan,
                }
            )
            continue
        result = flown.result
        offsets = sorted((r[0], r[7]) for r in flown.estimator.rows)
        then = flight.stamp_ns[0] + 20_000_000_000
        before = [offset for stamp, offset in offsets if stamp <= then]
        assert result.nees_position is not None
        tested = result.nis_tested or result.nis_position
        rows.append(
            {
                **row,
                "prmse": result.prmse,
                "pmae": result.pmae,
                "nees": result.nees_position.per_dof,
                "nis": tested.per_dof if tested else np.nan,
                "end": result.outage_error(50) if task.outage is not None else None,
                "offset_20": before[-1] if before else np.nan,
            }
        )
    return rows


def calibrate_task(data: Path, numbers: Sequence[int], imu: int) -> list[Row]:
    """Calibrate a session's flights jointly, by noisy fixes and by the reference itself."""
    flights = [load(data, number, imu) for number in numbers]
    given = parameters.defaults()
    found = calibrate(
        [as_recording(f, fixes(f, 5.0, 0, ())) for f in flights],
        given,
        own_offsets=True,
        search=1.0,
        antenna_is_base=True,
    )
    exact = calibrate(
        [as_recording(f, Fixes(f.truth.stamp_ns, f.position.lla, TRUTH)) for f in flights],
        {**given, "gnss.time_offset.value": found.values["gnss.time_offset.value"]},
        own_offsets=True,
        search=0.3,
        antenna_is_base=True,
        trust_fixes=True,
    )
    chosen = {k: v for k, v in found.values.items() if v != given[k]}
    return [
        {
            "flight": flight.name,
            "session": flight.session,
            "imu": imu,
            "values": {
                **chosen,
                **_biases([p for j, p in enumerate(found.after) if j != k]),
                **_clock(found.fitted, k),
            },
            "offset": found.fitted.offset(k),
            "sigma": found.fitted.sigma(f"offset_{k}"),
            "exact": exact.fitted.offset(k),
            "exact_sigma": exact.fitted.sigma(f"offset_{k}"),
            "imu_position": found.values["imu.position"],
            "exact_position": exact.values["imu.position"],
            "span": float(flight.position.t[-1] - flight.position.t[0]),
        }
        for k, flight in enumerate(flights)
    ]


def _clock(fitted: Fit, k: int) -> dict[str, float]:
    """Offset of a flight's clock and its σ, as a calibration by that flight alone writes them."""
    sigma = fitted.sigma(f"offset_{k}")
    return {
        "gnss.time_offset.value": float(fitted.offset(k)),
        "gnss.time_offset.std": sigma if sigma <= IDENTIFIED_OFFSET else 0.0,
    }


def _biases(others: Sequence[FilterPass]) -> dict[str, Any]:
    """
    Biases at a flight's start, by the session's other flights.

    By the flight itself they would be told by fixes that an outage is to hide.
    """
    if not others:
        return {}
    (bias_a, std_a), (bias_g, std_g) = next_biases(others)
    return {
        "imu.accelerometer_bias": (FLIP @ bias_a).tolist(),
        "imu.accelerometer_bias_std": std_a.tolist(),
        "imu.gyroscope_bias": (FLIP @ bias_g).tolist(),
        "imu.gyroscope_bias_std": std_g.tolist(),
    }


def simulate_task(kind: str, seed: int, duration: float) -> list[Row]:
    """Fly a simulated flight whose IMU has an error that its noise does not show."""
    scenario = Scenario(kind, duration=duration, errors=MISFITS[kind])
    run = draw(scenario, seed)
    methods = (Method(OURS, "scaled"), Method(NO_SCALE, "learned"), *HINDSIGHT)
    rows = []
    for method in methods:
        flight = montecarlo.fly(run, method)
        rows.append(
            {
                "kind": kind,
                "seed": seed,
                "method": method.name,
                "prmse": flight.prmse,
                "nees": float(np.mean(flight.position_nees)) / 3.0,
            }
        )
    return rows
