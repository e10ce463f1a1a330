"""A hundred thousand random messages over all their fields."""

import pytest
from support.fuzzer import run


@pytest.mark.parametrize(
    ("seed", "share", "count"), [(1, 0.05, 60_000), (2, 0.5, 30_000), (3, 1.0, 10_000)]
)
def test_long_streams_of_odd_messages(seed: int, share: float, count: int) -> None:
    estimator, renewed = run(seed, share, count)

    assert share > 0.1 or renewed > 20_000
    assert len(estimator.inputs.counts) > 10
