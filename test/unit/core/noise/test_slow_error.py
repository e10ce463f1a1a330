"""The slow error of positions that innovations have shown."""

import math

import pytest

from hybrid_ins.core.noise.slow_error import LASTING, SlowError

SECOND = 1_000_000_000
HALF_LIFE_NS = round(LASTING * math.log(2.0) * SECOND)


def test_what_was_probable_fades_and_what_was_not_is_gone() -> None:
    probable = SlowError().updated((2.0, 3.0), is_probable=True, t_ns=SECOND)
    improbable = SlowError().updated((2.0, 3.0), is_probable=False, t_ns=SECOND)
    assert probable.stds == improbable.stds == (2.0, 3.0)

    left = probable.updated((0.0, 0.0), is_probable=False, t_ns=SECOND + HALF_LIFE_NS)
    gone = improbable.updated((0.0, 0.0), is_probable=False, t_ns=SECOND + HALF_LIFE_NS)

    assert left.stds == pytest.approx((1.0, 1.5), rel=0.01) and gone.stds == (0.0, 0.0)


def test_one_that_is_probable_takes_the_place_of_another() -> None:
    error = SlowError().updated((2.0, 2.0), is_probable=True, t_ns=SECOND)

    of_heights = error.updated((0.0, 1.5), is_probable=True, t_ns=2 * SECOND)

    assert of_heights.stds == of_heights.lasting == (0.0, 1.5)


@pytest.mark.parametrize("was_probable", [True, False])
def test_what_is_reported_lasts_beside_a_smaller_one_that_is_probable(was_probable: bool) -> None:
    error = SlowError().updated((2.0, 2.0), is_probable=was_probable, t_ns=SECOND)

    error = error.updated((0.1, 0.1), is_probable=True, t_ns=SECOND + HALF_LIFE_NS)

    assert error.stds == error.lasting == (0.1, 0.1)
    assert error.past_variance == pytest.approx([1.0, 1.0, 2.25], rel=0.01)


def test_a_drift_of_heights_alone_is_what_they_have_besides_the_rest() -> None:
    both = SlowError().updated((1.0, 1.0), is_probable=True, t_ns=SECOND)
    heights = SlowError().updated((0.0, 1.0), is_probable=True, t_ns=SECOND)

    assert both.drifts == (1.0, 0.0)
    assert heights.drifts == (0.0, 1.5)
