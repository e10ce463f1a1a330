"""A receiver that never keeps what it claims is named, with the floor to set."""

import numpy as np
import pytest

from hybrid_ins.core.update.gate import Verdict
from hybrid_ins.core.update.measurements import PositionFix
from hybrid_ins.ros.reporting.input_log import InputLog
from hybrid_ins.ros.review.fix_scatter import FixScatter

PER_METRE = 1.0 / 6.378e6


def warnings(
    scatter: float,
    claimed: float,
    rejected: float,
    acceleration: float = 0.0,
    before: tuple[float, ...] = (),
) -> str:
    """
    Return what is said of 300 fixes at 5 Hz of a vehicle that goes to and fro.

    One that is right comes at each time ``before`` them [s].
    """
    rng = np.random.default_rng(1)
    log: list[str] = []
    watched = FixScatter(InputLog(lambda level, text: log.append(text)))
    for t in before:
        fix = PositionFix(round(t * 1e9), np.zeros(3), claimed**2 * np.eye(3), np.zeros(3))
        watched.on_verdict(Verdict(fix, True, "", 0.0, 3.0, 16.0, np.full(3, claimed)))
    for k in range(300):
        north = acceleration * np.sin(0.2 * k)  # of 1 rad/s
        place = np.append((rng.normal(0.0, scatter, 2) + np.array((north, 0.0))) * PER_METRE, 0.0)
        fix = PositionFix(200_000_000 * (k + 1), place, claimed**2 * np.eye(3), np.zeros(3))
        accepted = rng.random() >= rejected
        nis = 3.0 if accepted else 500.0
        watched.on_verdict(Verdict(fix, accepted, "", 0.0, nis, 16.0, np.full(3, claimed)))
    return " / ".join(log)


def test_a_claim_that_is_never_kept_is_named_with_the_floor() -> None:
    text = warnings(scatter=0.5, claimed=0.01, rejected=0.9)

    assert "fixes rejected: they scatter by 0." in text
    assert "σ 0.01 m is used: set gnss.position_std_min to 0." in text
    floor = float(text.split("gnss.position_std_min to ")[1].split(" ")[0])
    assert 0.4 <= floor <= 0.7
    assert text.count("scatter") <= 2


def test_it_is_named_also_after_the_stamps_went_back() -> None:
    assert "scatter by 0." in warnings(0.5, 0.01, 0.9, before=(3599.0, 3600.0))


@pytest.mark.parametrize(
    ("scatter", "claimed", "rejected", "acceleration"),
    [
        (0.01, 0.01, 0.9, 0.0),  # rejected for another reason: wrong axes, a jump
        (0.02, 0.01, 0.9, 5.0),  # the same of a vehicle in motion
        (0.5, 0.01, 0.1, 0.0),  # accepted nevertheless
        (0.5, 0.5, 0.0, 0.0),
    ],
)
def test_other_receivers_are_not_accused(
    scatter: float, claimed: float, rejected: float, acceleration: float
) -> None:
    assert warnings(scatter, claimed, rejected, acceleration) == ""
