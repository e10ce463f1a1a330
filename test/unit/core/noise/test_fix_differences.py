"""What fixes scatter by, before a filter has judged them."""

import numpy as np
import pytest

from hybrid_ins.core.imu.samples import SAMPLE_DTYPE, ImuRing
from hybrid_ins.core.inertial.earth import LocalFrame
from hybrid_ins.core.noise.fix_differences import KEPT, FixDifferences
from hybrid_ins.core.noise.hypotheses import COUNT
from hybrid_ins.core.noise.multiple_model import NoiseMultipleModelBank
from hybrid_ins.core.update.measurements import PositionFix

SECOND = 1_000_000_000
FRAME = LocalFrame(np.array([0.8, 0.2, 500.0]))


def differences(
    white: float, claimed: float, rate: float = 5.0, count: int = KEPT, seed: int = 0
) -> tuple[FixDifferences, ImuRing]:
    """Return fixes of a vehicle that brakes and turns at up to 3 m/s², and its IMU's samples."""
    rng, seen, ring = np.random.default_rng(seed), FixDifferences(), ImuRing()
    t = np.arange(0.0, (count + 1) / rate, 0.01)
    samples = np.zeros(len(t), SAMPLE_DTYPE)
    samples["t_ns"] = SECOND + np.rint(t * SECOND)
    samples["f"] = np.stack((3.0 * np.sin(1.5 * t), 3.0 * np.cos(1.5 * t), -9.8 + 0.0 * t), axis=1)
    ring.extend(samples)
    for k in range(count):
        moved = -3.0 / 1.5**2 * np.array([np.sin(1.5 * k / rate), np.cos(1.5 * k / rate), 0.0])
        lla = FRAME.lla((moved + white * rng.standard_normal(3))[None])[0]
        stamp = SECOND + round(k / rate * SECOND)
        seen.observe(PositionFix(stamp, lla, claimed**2 * np.eye(3), np.zeros(3)))
    return seen, ring


def factor(seen: FixDifferences, ring: ImuRing) -> float:
    """Return the factor on R that noise hypotheses begin with."""
    shown, bank = seen.shown(ring), NoiseMultipleModelBank()
    if shown is not None:
        bank.add_log_likelihood(shown[0])
    return bank.found.fixes * bank.found.heights


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("white", "claimed"), [(0.5, 0.02), (0.3, 0.01), (1.0, 0.1)])
def test_fixes_that_scatter_by_more_than_they_claim_are_known_at_once(
    white: float, claimed: float, seed: int
) -> None:
    found = factor(*differences(white, claimed, seed=seed))

    assert (white / claimed) ** 2 / 6.0 < found < 6.0 * (white / claimed) ** 2


@pytest.mark.parametrize("rate", [1.0, 5.0, 10.0])
@pytest.mark.parametrize("claimed", [0.02, 0.5])
def test_motion_is_no_scatter(claimed: float, rate: float) -> None:
    assert factor(*differences(claimed, claimed, rate)) < 2.0


def test_few_fixes_and_uneven_ones_show_nothing() -> None:
    seen, ring = differences(0.5, 0.02, count=6)
    assert seen.shown(ring) is None and not seen.begins_to_show

    seen, ring = differences(0.5, 0.02, count=7)
    shown = seen.shown(ring)
    assert seen.begins_to_show and shown is not None
    log_likelihood, claimed_std = shown
    assert log_likelihood.shape == (COUNT,) and claimed_std == pytest.approx(np.full(3, 0.02))
    assert log_likelihood.max() == 0.0

    uneven = FixDifferences()
    for k in range(KEPT):
        stamp = SECOND + round(2.0**k)
        uneven.observe(PositionFix(stamp, FRAME.lla(np.zeros((1, 3)))[0], np.eye(3), np.zeros(3)))
    assert uneven.shown(ring) is None


def test_a_jump_is_no_scatter() -> None:
    """GIVEN one fix far off THEN the factor is that of the others."""
    seen, ring = differences(0.02, 0.02, count=KEPT - 8)
    for k in range(KEPT - 8, KEPT):
        stamp = SECOND + round(k / 5.0 * SECOND)
        moved = -3.0 / 1.5**2 * np.array([np.sin(0.3 * k), np.cos(0.3 * k), 0.0])
        moved[0] += 2.0 * (k == KEPT - 6)
        seen.observe(PositionFix(stamp, FRAME.lla(moved[None])[0], 4e-4 * np.eye(3), np.zeros(3)))

    assert factor(seen, ring) < 10.0
