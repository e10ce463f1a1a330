"""Clock and heading are found, and a stand shows neither, with other seeds, too."""

import numpy as np
import pytest
from support.clock_searches import assert_heading_and_clock_are_found, nees_after_takeover
from support.long_stand import assert_standing_shows_nothing_of_the_clock


@pytest.mark.parametrize(("seed", "value", "true"), [(1, 0.0, 0.3), (3, 0.0, 0.12)])
def test_heading_and_clock_are_found_together(seed: int, value: float, true: float) -> None:
    assert_heading_and_clock_are_found(seed, value, true)


def test_the_filter_that_takes_over_is_where_it_says() -> None:
    """Its position is wrong by what the covariance allows, in the mean of 24 numbers."""
    assert 0.3 < np.mean(nees_after_takeover(range(8))) < 2.2


@pytest.mark.parametrize("seed", [1, 2])
def test_standing_shows_nothing_of_the_clock(seed: int) -> None:
    assert_standing_shows_nothing_of_the_clock(seed)
