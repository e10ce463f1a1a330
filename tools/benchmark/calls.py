"""The calls around the filter: GNSS update, rewind, regressor, and a sample through the node."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np

from hybrid_ins import parameters
from hybrid_ins.bags.messages import new_message
from hybrid_ins.calibration.innovations import N_SAID, POSITION, empty_states, innovations
from hybrid_ins.core.filter.filter_noise import FilterNoise
from hybrid_ins.core.filter.filter_settings import FilterSettings
from hybrid_ins.core.filter.ins_filter import InsFilter
from hybrid_ins.core.imu.samples import ImuRing
from hybrid_ins.core.inertial.state import PSD
from hybrid_ins.core.noise.multiple_model import NoiseMultipleModelBank
from hybrid_ins.core.noise.process_noise import ConstantNoise, ProcessNoise
from hybrid_ins.core.update.gate import Gate
from hybrid_ins.core.update.measurements import PositionFix
from hybrid_ins.noise_regressor.reader import NoiseReader
from hybrid_ins.ros.estimator.estimator import Estimator
from hybrid_ins.ros.messages.cdr import ImuDecoder, OdometryEncoder, StampedEncoder
from hybrid_ins.ros.messages.conversions import set_stamp
from tools.benchmark.contenders import (
    FIX_RATE,
    LEVER,
    RATE,
    psd,
    reading,
)
from tools.benchmark.table import Section
from tools.paper.runs import Run, Scenario, draw

RUNS = 100
CALLS_AHEAD = 2000  # fixes that are made before the clock runs


def measure_calls(section: Section, run: Run, quick: bool) -> None:
    """GNSS update, rewind, regressor, and all that the node computes for one sample."""
    repetitions, calls = (2, 20) if quick else (15, 100)
    section.add(
        "GNSS update",
        "µs",
        _timed(_update_call(run, None), repetitions, calls),
        5.0,
        note="gate, clock offset, noise model and checkpoint included",
    )
    section.add(
        "GNSS update with noise factors",
        "µs",
        _timed(_update_call(run, NoiseMultipleModelBank()), repetitions, calls),
        note="the same, and the bank of noise hypotheses",
    )
    section.add(
        f"batch of {RUNS} runs at once",
        "µs",
        _runs_at_once(run, repetitions),
        note="a sample of a run, fixes included, all processors",
    )
    for rate in (RATE, 1000.0):
        section.add(
            f"rewind of 0.5 s at {rate:.0f} Hz",
            "µs",
            _rewinds(rate, repetitions, 3 if quick else 10),
        )
    for name, call in _regressor_calls():
        section.add(
            f"regressor call, {name}",
            "µs",
            _timed(call, repetitions, calls),
            note="six channels, window checked",
        )
    section.add(
        "one sample through the node without DDS",
        "µs",
        _timed(_sample_call(), repetitions, 10 * calls),
        note="bytes in, both odometries out as bytes",
    )


def _timed(call: Callable[[], object], repetitions: int, calls: int) -> list[float]:
    """Return the mean time of a call [µs], once for each repetition."""
    for _ in range(3):
        call()
    times = []
    for _ in range(repetitions):
        start = time.perf_counter()
        for _ in range(calls):
            call()
        times.append((time.perf_counter() - start) / calls * 1e6)
    return times


def _filter(
    run: Run, rate: float, factors: NoiseMultipleModelBank | None = None
) -> tuple[InsFilter, ImuRing]:
    ring = ImuRing()
    ring.extend(run.samples[:1])
    ins = InsFilter(
        run.start,
        int(run.samples["t_ns"][0]),
        np.array(reading(run, 0)),
        FilterNoise(ConstantNoise(run.q[0]), ProcessNoise(run.bias_walk, 1.0 / rate), factors),
        Gate({3: np.inf}, 3.0),
        ring,
        FilterSettings(),
    )
    return ins, ring


def _update_call(run: Run, factors: NoiseMultipleModelBank | None) -> Callable[[], None]:
    ins, ring = _filter(run, RATE, factors)
    ring.extend(run.samples[1:200])
    ins.predict_block(run.samples[1:200])
    first_ns, period_ns = ins.t_ns, int(1e9 / FIX_RATE)
    R = run.fixes[0].covariance_n
    made = [
        PositionFix(first_ns + k * period_ns, run.start.lla, R, LEVER)
        for k in range(CALLS_AHEAD, 0, -1)
    ]

    def call() -> None:
        fix = made.pop()
        ins.t_ns = fix.t_ns  # no samples between two fixes; old checkpoints expire
        ins.submit(fix)
        ins.verdicts.clear()

    return call


def _runs_at_once(run: Run, repetitions: int) -> list[float]:
    """Return the times [µs] of a sample of a run, of many runs by the filter of calibration."""
    stamps = run.samples["t_ns"]
    t = (stamps - stamps[0]) * 1e-9
    samples = np.hstack((run.samples["f"], run.samples["w"]))
    aid_t = np.array([(fix.t_ns - stamps[0]) * 1e-9 for fix in run.fixes])
    aid = np.array([fix.lla for fix in run.fixes])
    R = np.array([fix.covariance_n for fix in run.fixes])
    kind = np.full(len(aid), POSITION)
    count, noise = len(aid), np.ones((len(samples), 2))

    def fly(_: int) -> None:
        nav = run.start.to_flat()
        nav[PSD] = psd(run)
        z, S, nis = np.empty((count, 3)), np.empty((count, 3, 3)), np.empty(count)
        innovations(
            nav,
            t,
            samples,
            noise,
            aid_t,
            kind,
            aid,
            R,
            np.zeros((count, 3)),
            LEVER,
            0.01 - 1e-6,
            0.0,
            z,
            S,
            nis,
            empty_states(),
            np.empty((0, N_SAID)),
        )

    fly(0)
    times = []
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for _ in range(repetitions):
            start = time.perf_counter()
            list(pool.map(fly, range(RUNS)))
            times.append((time.perf_counter() - start) / (RUNS * len(t)) * 1e6)
    return times


def _rewinds(rate: float, repetitions: int, fixes: int) -> list[float]:
    """Times [µs] of a fix that is half a second late, in a 5 Hz stream that all are."""
    run = draw(Scenario("late", rate=rate, fix_rate=FIX_RATE, duration=fixes / FIX_RATE + 2.0), 2)
    late_ns = 500_000_000
    stamps = run.samples["t_ns"]
    times = []
    for _ in range(repetitions):
        ins, ring = _filter(run, rate)
        at, spent = 1, []
        for fix in run.fixes:
            stop = int(np.searchsorted(stamps, fix.t_ns + late_ns, side="right"))
            if stop >= len(stamps):
                break
            if stop > at:
                ring.extend(run.samples[at:stop])
                ins.predict_block(run.samples[at:stop])
                at = stop
            start = time.perf_counter()
            ins.submit(fix)
            spent.append(time.perf_counter() - start)
        times.append(float(np.median(spent)) * 1e6)
    return times


def _regressor_calls() -> Iterator[tuple[str, Callable[[], object]]]:
    run = draw(Scenario("window", rate=RATE, duration=5.0), 3)
    ring = ImuRing()
    ring.extend(run.samples)
    t_ns = int(run.samples["t_ns"][-1])
    for model in ("paper", "plateau", "spectral"):
        reader = NoiseReader(
            {**parameters.defaults(), "noise.model": model}, np.eye(3), lambda level, text: None
        )
        yield reader.regressor.name, partial(reader.read, ring, t_ns)


def _sample_call() -> Callable[[], None]:
    values = {
        **parameters.defaults(),
        "alignment.heading_source": "parameter",
        "noise.mode": "constant",
    }
    estimator = Estimator(values, lambda level, text: None)
    decode = ImuDecoder().decode
    imu = StampedEncoder(("imu_link",), 37)
    outputs = [OdometryEncoder("map", "base_link"), OdometryEncoder("odom", "base_link")]
    imu.values[27] = 9.8  # z of the specific force

    fix = new_message("sensor_msgs/msg/NavSatFix")
    fix.latitude, fix.longitude = 32.1, 34.8
    clock = [0]

    def call() -> None:
        clock[0] += 1_000_000
        odometry = estimator.handle_imu(decode(imu.message(clock[0])))
        if odometry is not None:
            for output, values in zip(outputs, odometry[1:], strict=True):
                output.encode_values(odometry.t_ns, values)
        estimator.run_periodic()
        estimator.pop_reports()

    while not estimator.aligned:
        call()
        if clock[0] % 200_000_000 == 0:
            set_stamp(fix.header.stamp, clock[0])
            estimator.handle_fix(fix)
        if clock[0] > 10_000_000_000:
            raise RuntimeError("the benchmark's estimator did not start")
    return call
