"""Factors from the innovations: 1 while the model is right, and on what is wrong when it is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybrid_ins.core.gate import Gate
from hybrid_ins.core.ins_filter import FilterSettings, InsFilter
from hybrid_ins.core.measurements import PositionFix
from hybrid_ins.core.noise import ConstantNoise, ProcessNoise, ScaledNoise
from hybrid_ins.core.noise_multiple_model import NoiseScale
from hybrid_ins.core.samples import ImuRing
from hybrid_ins.core.state import N_NAV
from tools.paper.montecarlo import Run, Scenario, draw

SCENE = Scenario("flight", rate=100.0, duration=50.0)
Q = np.repeat([4e-4, 4e-6], 3)


def begin(run: Run) -> InsFilter:
    stamps = run.samples["t_ns"]
    process = ProcessNoise(run.bias_walk, 0.01)
    ring = ImuRing()
    ring.extend(run.samples[:1])
    return InsFilter(
        run.start,
        int(stamps[0]),
        np.concatenate((run.samples["f"][0], run.samples["w"][0])),
        ScaledNoise(ConstantNoise(Q), process, NoiseScale()),
        process,
        Gate({3: 25.0}, 3.0),
        ring,
        FilterSettings(max_delay=1.0),
    )


def fly(run: Run, *, late: float = 0.0) -> tuple[InsFilter, np.ndarray]:
    """Run the filter, each fix given ``late`` [s] after its stamp; returns the factors (M, 3)."""
    ins, at, factors = begin(run), 0, []
    stamps = run.samples["t_ns"]
    for fix in run.fixes:
        stop = int(np.searchsorted(stamps, fix.t_ns + round(late * 1e9), side="right"))
        if stop > at + 1:
            ins.ring.extend(run.samples[at + 1 : stop])
            ins.process_imu_block(run.samples[at + 1 : stop])
            at = stop - 1
        ins.submit(fix)
        factors.append((*ins.noise.scale.scale(), ins.noise.fix_factor))  # type: ignore[attr-defined]
    if at + 1 < len(stamps):
        ins.ring.extend(run.samples[at + 1 :])
        ins.process_imu_block(run.samples[at + 1 :])
    return ins, np.array(factors)


def moved(run: Run, change: np.ndarray) -> Run:
    """Move the fixes by so many metres, (M, 3) north, east, down."""
    scale = np.array([1.0 / 6.37e6, 1.0 / 5.35e6, -1.0])
    fixes = tuple(replace(f, lla=f.lla + d * scale) for f, d in zip(run.fixes, change, strict=True))
    return replace(run, fixes=fixes)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_right_model_is_left_alone(seed: int) -> None:
    _, factors = fly(draw(SCENE, seed))
    medians = np.median(factors[100:], axis=0)
    assert np.all(medians > 0.6) and np.all(medians < 1.05)
    assert np.all(factors[100:] < 1.5)


@pytest.mark.parametrize("seed", [0, 3, 4])
def test_an_outage_is_no_evidence_against_the_imu(seed: int) -> None:
    # GIVEN a flight with a right model, and a quarter of a minute without fixes
    _, factors = fly(draw(replace(SCENE, outages=((20.0, 15.0),)), seed))

    assert np.all(factors < 3.0)


def test_a_clock_offset_raises_the_noise_of_the_imu() -> None:
    # GIVEN fixes stamped 0.4 s wrong, which no look at the IMU can tell
    run = draw(SCENE, 1)
    fixes = tuple(
        PositionFix(f.t_ns - 400_000_000, f.lla, f.covariance_n, f.lever_b)
        for f in run.fixes
        if f.t_ns > int(run.samples["t_ns"][0]) + 500_000_000
    )
    # WHEN the filter runs
    ins, factors = fly(replace(run, fixes=fixes))
    # THEN its noise is taken to be many times larger, and the fixes are taken
    assert np.max(factors[50:, :2]) > 30.0
    assert np.mean([v.accepted for v in list(ins.verdicts)[100:]]) > 0.95


def test_a_receiver_that_claims_too_much_is_not_mistaken_for_the_imu() -> None:
    # GIVEN fixes that scatter five times as far as they say
    run = draw(SCENE, 2)
    std = np.sqrt(np.diag(run.fixes[0].covariance_n))
    scatter = np.random.default_rng(0).standard_normal((len(run.fixes), 3)) * std * 24.0**0.5
    # WHEN the filter runs
    _, factors = fly(moved(run, scatter))
    # THEN R is raised by about 25, and the process noise is not
    assert 8.0 < np.median(factors[100:, 2]) < 80.0
    assert np.median(factors[100:, :2]) < 1.5


def test_a_lone_outlier_changes_nothing() -> None:
    # GIVEN one fix that is off by 30 m
    run = draw(SCENE, 3)
    change = np.zeros((len(run.fixes), 3))
    change[150, 0] = 30.0
    # WHEN the filter runs
    _, without = fly(run)
    _, factors = fly(moved(run, change))
    # THEN the factors stay where they were
    assert np.max(factors[150:] / without[150:]) < 1.3


def test_late_fixes_give_the_same_factors_and_the_same_state() -> None:
    run = draw(SCENE, 4)
    std = np.sqrt(np.diag(run.fixes[0].covariance_n))
    scatter = np.random.default_rng(1).standard_normal((len(run.fixes), 3)) * std * 4.0
    run = moved(run, scatter)
    run = replace(run, fixes=tuple(f for f in run.fixes if f.t_ns < run.samples["t_ns"][-100]))
    in_time, factors = fly(run)
    late, _ = fly(run, late=0.35)
    assert late.noise.fix_factor == pytest.approx(in_time.noise.fix_factor, rel=1e-9)
    np.testing.assert_allclose(late.nav[:N_NAV], in_time.nav[:N_NAV], rtol=1e-9, atol=1e-9)
    assert np.max(factors) > 3.0
