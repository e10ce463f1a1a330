"""The clock offset stays within its uncertainty for five minutes, with other seeds, too."""

import pytest
from support.endurance import assert_clock_is_within_three_sigma


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize(
    ("kind", "offset"), [("standing", 0.0), ("cruise", 0.2), ("smooth drive", -0.1)]
)
def test_clock_offset_stays_within_its_uncertainty(kind: str, offset: float, seed: int) -> None:
    assert_clock_is_within_three_sigma(kind, offset, seed)
