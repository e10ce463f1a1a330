"""Random messages over all their fields: nothing raises, no NaN comes out."""

from support.fuzzer import run

MESSAGES = 2_000


def test_sound_messages_with_odd_ones_between_them() -> None:
    estimator, renewed = run(1, 0.05, MESSAGES)
    assert renewed > 0.2 * MESSAGES
    assert len(estimator.inputs.counts) > 10


def test_mostly_odd_messages() -> None:
    run(2, 0.5, MESSAGES)


def test_nothing_but_odd_messages() -> None:
    run(3, 1.0, 800)


def test_odd_messages_while_the_heading_is_searched() -> None:
    run(4, 0.05, 800, **{"alignment.heading_source": "auto"})
