"""What a calibration says of its innovations and of the receiver."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from hybrid_ins.calibration.calibrate import Calibration
from hybrid_ins.calibration.filter_pass import FilterPass
from hybrid_ins.calibration.fit import Fit
from hybrid_ins.calibration.fix_scatter import SCATTER, scatter_findings
from hybrid_ins.calibration.innovations import POSITION, VELOCITY
from hybrid_ins.calibration.likelihood import POSITION_SCALE, SLOW_SHARE, VELOCITY_SCALE
from hybrid_ins.calibration.recording import Recording
from hybrid_ins.calibration.report import innovation_line

NAMES = POSITION_SCALE, SLOW_SHARE


def recording(kinds: list[int], states_std: bool = True) -> Recording:
    M = len(kinds)
    return Recording(
        "drive", np.zeros(2), np.zeros((2, 6)), np.zeros(M), np.array(kinds), np.zeros((M, 3)),
        np.zeros((M, 3, 3)), states_std=states_std,
    )  # fmt: skip


def fitted(*recordings: Recording, factor: float = 1.0, sigma: float = 0.1) -> Fit:
    """Return a fit whose fixes scatter by a factor on their standard deviation."""
    x = np.array([2.0 * math.log(factor), -4.0])
    return Fit(
        NAMES, x, np.full(2, sigma), (), frozenset({VELOCITY_SCALE}), (), recordings, np.zeros(1),
        np.zeros((1, 1)), np.zeros(2), True, np.zeros((0, 2)),
    )  # fmt: skip


def line(kinds: list[int], z: np.ndarray) -> str:
    S = np.tile(np.eye(3), (len(z), 1, 1))
    one = FilterPass(z, S, np.nansum(z**2, axis=1), np.empty((0, 1)))
    whole = fitted(recording(kinds))
    return innovation_line(Calibration(whole, [one], [replace(one, z=0.5 * z)], [], {}, {}, []))


def test_metres_are_not_averaged_with_metres_a_second() -> None:
    z = np.array([[3.0, 3.0, 3.0], [0.1, 0.1, np.nan]])

    assert "RMS 3.000 -> 1.500 m, RMS 0.100 -> 0.050 m/s," in line([POSITION, VELOCITY], z)
    assert "RMS 3.000 -> 1.500 m, median" in line([POSITION], z[:1])


@pytest.mark.parametrize(("flat", "expected"), [(0, 2.4), (20, 1.4), (5, 2.1)])
def test_the_median_that_is_expected_is_that_of_the_components_that_were_measured(
    flat: int, expected: float
) -> None:
    """Chi-square of 3 and of 2 degrees of freedom, and of both: 1.386, 2.366, and between."""
    z = np.ones((20, 3))
    z[:flat, 2] = np.nan

    assert f"({expected} expected)" in line([POSITION] * 20, z)


@pytest.mark.parametrize(
    ("states", "reference", "words", "verdict"),
    [
        ([True, True], "stated σ", "the receiver's σ is too large", "identified"),
        ([False, False], "default σ", "states no σ: gnss.position_std_default", "identified"),
        ([True, False], "σ", "states its σ in some recordings only", "weak"),
    ],
)
def test_what_the_receiver_did_not_state_is_not_its_fault(
    states: list[bool], reference: str, words: str, verdict: str
) -> None:
    fit = fitted(*(recording([POSITION], one) for one in states), factor=0.4)

    scatter, slow = scatter_findings(fit, given=1.0)

    assert scatter.value == f"0.4 × {reference}"
    assert slow.value.endswith(f"× {reference}")
    assert words in scatter.note
    assert scatter.verdict == verdict
    assert scatter.values[SCATTER] == (0.4 if verdict == "identified" else 1.0)
