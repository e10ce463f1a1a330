"""What the innovations ask for besides the noise that is known."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hybrid_ins.core.filter.filter_noise import PROBABLE, FilterNoise
from hybrid_ins.core.imu.samples import SAMPLE_DTYPE, ImuRing
from hybrid_ins.core.inertial.state import CLOCK_VARIANCE, N_FLAT, W_G
from hybrid_ins.core.noise.multiple_model import NoiseMultipleModelBank
from hybrid_ins.core.noise.position_jumps import PositionJumps
from hybrid_ins.core.noise.process_noise import ConstantNoise, ProcessNoise
from hybrid_ins.core.noise.slow_error import SlowError
from hybrid_ins.core.noise.weights import NoiseFactors
from hybrid_ins.ros.reporting.diagnostics import noise_conditions, status


def navigator(factor: float, turning: float, extra_std: float) -> Any:
    """Return one whose gyroscopes need ``extra_std`` [rad/√s] more, turning by so many rad/s."""
    psd = np.zeros(12)
    psd[W_G] = extra_std**2 * factor / (factor - 1.0)
    noise = SimpleNamespace(
        imu_factors=(500.0, factor),
        factors=None,
        slow_error=SlowError(),
        jumps=PositionJumps(),
        split=SimpleNamespace(claimed_stds=(1.0, 1.0)),
        found=NoiseFactors(),
        psd=lambda: psd,
    )
    samples, ring = np.zeros(500, SAMPLE_DTYPE), ImuRing()
    samples["w"][:, 2] = turning
    ring.extend(samples)
    running = SimpleNamespace(noise=noise, nav=np.zeros(N_FLAT), t_ns=0)
    return SimpleNamespace(filter=running, ring=ring)


@pytest.mark.parametrize(
    ("factor", "turning", "extra_std", "is_told"),
    [
        (100.0, 0.1, 0.01, True),  # a slow vehicle, with ten times what 1 % of its turns makes
        (100.0, 2.0, 0.01, False),  # a hand that waves: 1 % of its turns makes 0.02
        (2.0, 0.1, 0.01, False),
    ],
)
def test_rates_are_blamed_for_more_than_ordinary_errors_of_their_scale(
    factor: float, turning: float, extra_std: float, is_told: bool
) -> None:
    found = noise_conditions(navigator(factor, turning, extra_std))
    assert ("the angular rates disagree with GNSS" in found) is is_told


def test_the_accelerometers_factor_alone_is_no_condition() -> None:
    """It exceeds three on half of all sound vehicles."""
    assert noise_conditions(navigator(1.5, 0.0, 1e-6)) == {}


@pytest.mark.parametrize(
    ("claimed", "drift", "probability", "is_blamed"),
    [
        (1.2, 3.0, 1.0, False),  # a consumer receiver, whose claim is that of the slow error
        (0.95, 3.0, 1.0, False),
        (1.2, 10.0, 1.0, True),  # which it is not
        (0.6, 1.0, 1.0, False),
        (0.6, 3.0, 1.0, True),
        (0.3, 1.0, 1.0, True),
        (0.12, 1.0, 1.0, True),
        (0.01, 0.3, 1.0, True),
        (0.01, 0.04, 1.0, True),  # of which one decimal would say 0.0 m
        (0.01, 0.3, 0.4, False),
        (0.3, 0.0, 1.0, False),
    ],
)
def test_receivers_are_blamed_for_drifts_of_clearly_more_than_their_claim(
    claimed: float, drift: float, probability: float, is_blamed: bool
) -> None:
    noise = FilterNoise(
        ConstantNoise(np.ones(6)), ProcessNoise(np.ones(6), 0.01), NoiseMultipleModelBank()
    )
    noise.split = noise.split._replace(claimed_stds=(claimed, claimed))
    assert noise.factors is not None
    noise.slow_error = SlowError().updated((drift, drift), probability > PROBABLE, 0)

    found = noise_conditions(
        SimpleNamespace(filter=SimpleNamespace(noise=noise, nav=np.zeros(N_FLAT), t_ns=0))
    )

    text = found.get("fixes drift by more than they claim", "")
    assert bool(found) is is_blamed and text.startswith("fixes drift" if is_blamed else "")
    assert (f"drift by about {drift} m although they claim {claimed:.2g} m" in text) is is_blamed


@pytest.mark.parametrize(
    ("fixes", "heights", "named"),
    [(1.0, 2.0, ""), (1.0, 9.0, "the heights of fixes scatter"), (9.0, 1.0, "fixes scatter")],
)
def test_what_scatters_by_more_than_it_claims_is_named(
    fixes: float, heights: float, named: str
) -> None:
    bank = NoiseMultipleModelBank()
    noise = FilterNoise(ConstantNoise(np.ones(6)), ProcessNoise(np.ones(6), 0.01), bank)
    bank.found = NoiseFactors(fixes=fixes, heights=heights)

    found = noise_conditions(
        SimpleNamespace(filter=SimpleNamespace(noise=noise, nav=np.zeros(N_FLAT), t_ns=0))
    )

    assert [text.split(" by more")[0] for text in found.values()] == [named] * bool(named)


@pytest.mark.parametrize(("clock_std", "named"), [(0.0, True), (0.01, True), (0.1, False)])
def test_stamps_are_not_blamed_for_an_offset_that_is_not_known_yet(
    clock_std: float, named: bool
) -> None:
    bank, nav = NoiseMultipleModelBank(), np.zeros(N_FLAT)
    noise = FilterNoise(ConstantNoise(np.ones(6)), ProcessNoise(np.ones(6), 0.01), bank)
    bank.found = NoiseFactors(stamp_probability=0.9, stamp_std=0.03)
    nav[CLOCK_VARIANCE] = clock_std**2

    found = noise_conditions(SimpleNamespace(filter=SimpleNamespace(noise=noise, nav=nav, t_ns=0)))

    assert ("stamps of fixes scatter" in found) is named


def test_truths_are_written_as_json_reads_them() -> None:
    found = status("vehicle", 0, "", {"stands": False, "fused": True, "count": 1, "x": 0.5})

    assert [word for _, word in found.values] == ["false", "true", "1", "0.5"]
