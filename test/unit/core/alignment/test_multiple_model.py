"""When filters of several headings have become one."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hybrid_ins.core.alignment.multiple_model import HEADING_STD, N_HEADINGS, MultipleModelBank
from hybrid_ins.core.filter.events import CovarianceInflation, Event, FilterChosen
from hybrid_ins.core.filter.filter_noise import FilterNoise
from hybrid_ins.core.filter.filter_settings import FilterSettings
from hybrid_ins.core.filter.ins_filter import InsFilter
from hybrid_ins.core.imu.samples import ImuRing
from hybrid_ins.core.inertial.rotations import quat_from_rpy
from hybrid_ins.core.inertial.state import HEADING_VARIANCE, N_ERROR, NavState
from hybrid_ins.core.noise.process_noise import ConstantNoise, ProcessNoise
from hybrid_ins.core.update.gate import Gate, Verdict
from hybrid_ins.core.update.measurements import PositionFix

SECOND = 1_000_000_000


def begin(state: NavState, settings: FilterSettings) -> Any:
    events: list[Event] = []
    one = SimpleNamespace(nav=state.to_flat(), t_ns=SECOND, verdicts=deque(), events=events)
    one.submit = events.append
    return one


@pytest.fixture
def bank() -> MultipleModelBank:
    """Return filters of several headings, of which one is left: it knows its own to 3°."""
    at_rest = NavState(
        np.array([0.5, 0.1, 0.0]),
        np.zeros(3),
        np.array([0.0, 0.0, 0.0, 1.0]),
        np.zeros(3),
        np.zeros(3),
        0.05**2 * np.eye(N_ERROR),
    )
    found = MultipleModelBank([at_rest] * N_HEADINGS, begin, FilterSettings())
    assert found.heading_open
    return found


def decided(bank: MultipleModelBank, seconds: float) -> bool:
    """Let the filters go on for a while; return whether they are one filter at its end."""
    decision = None
    for _ in range(round(10.0 * seconds)):
        for one in bank.filters:
            one.t_ns += SECOND // 10
        decision = bank.decide()
    return decision is not None


def test_at_rest_no_heading_is_known(bank: MultipleModelBank) -> None:
    assert not decided(bank, 20.0)


def test_a_heading_counts_as_known_from_the_first_motion_on(bank: MultipleModelBank) -> None:
    # GIVEN a vehicle that has stood for long, and begins to move
    decided(bank, 20.0)
    bank.motion.moves = True
    assert not decided(bank, 1.5)
    # WHEN the motion has lasted THEN what was known meanwhile has lasted, too
    bank.motion.shown = True
    assert decided(bank, 0.1)


def test_a_stand_before_does_not_count(bank: MultipleModelBank) -> None:
    decided(bank, 20.0)
    bank.motion.moves = bank.motion.shown = True
    assert not decided(bank, 0.5)
    assert decided(bank, 1.0)


def test_without_an_open_heading_one_filter_is_enough(bank: MultipleModelBank) -> None:
    bank.heading_open = False
    assert decided(bank, 0.1)


def weigh(bank: MultipleModelBank, t: float, nis: np.ndarray, jump: bool = False) -> np.ndarray:
    """Let a fix be evidence that has these NIS under the hypotheses; return the weights."""
    fix = PositionFix(int(t * SECOND), np.zeros(3), np.eye(3), np.zeros(3))
    bank._weigh([Verdict(fix, True, "", 0.0, v, 21.1, np.ones(3), jump=jump) for v in nis])
    return np.exp(bank.log_weights)


def nis_of(bank: MultipleModelBank, first: float, others: float) -> np.ndarray:
    return np.concatenate(([first], np.full(len(bank.filters) - 1, others)))


def test_what_follows_a_jump_that_no_hypothesis_explains_is_no_evidence(
    bank: MultipleModelBank,
) -> None:
    before = np.exp(bank.log_weights)
    # WHEN the first hypothesis is also the first to return to the fixes
    after = [
        weigh(bank, 1.0, nis_of(bank, 900.0, 1000.0), jump=True),
        *[weigh(bank, 1.0 + 0.2 * k, nis_of(bank, 2.0, 900.0)) for k in range(1, 10)],
        weigh(bank, 3.0, nis_of(bank, 1.0, 9.0)),
    ]
    # THEN that is no evidence, before all agree again
    for weights in after[:-1]:
        np.testing.assert_array_equal(weights, before)
    assert after[-1][0] > 5.0 * after[-1][1]


def test_hypotheses_that_never_return_are_wrong(bank: MultipleModelBank) -> None:
    weigh(bank, 1.0, nis_of(bank, 900.0, 1000.0), jump=True)

    weights = weigh(bank, 6.1, nis_of(bank, 2.0, 900.0))

    assert weights[0] > 0.99


@pytest.mark.parametrize(("first", "jump"), [(2.0, True), (25.0, False)])
def test_what_one_explains_or_an_ins_may_have_done_is_evidence(
    bank: MultipleModelBank, first: float, jump: bool
) -> None:
    """A large innovation of all is as likely under each, but the next one is weighed."""
    weigh(bank, 1.0, nis_of(bank, first, 900.0), jump)
    weights = weigh(bank, 1.2, nis_of(bank, 2.0, 20.0))

    assert weights[0] > 0.9


def test_a_hypothesis_whose_state_is_lost_does_not_hold_up_the_others(
    bank: MultipleModelBank,
) -> None:
    lost = bank.filters[3]
    lost.nav[0] = np.nan

    bank._weigh_decided()

    assert len(bank.filters) == N_HEADINGS - 1 and all(one is not lost for one in bank.filters)
    assert weigh(bank, 1.0, nis_of(bank, 2.0, 20.0))[0] > 0.9
    # AND where all are lost, it is not for a bank to say which is right
    for one in bank.filters:
        one.nav[0] = np.nan
    bank._weigh_decided()
    assert len(bank.filters) == N_HEADINGS - 1


def level(yaw: float) -> NavState:
    """Return the state of a vehicle that stands, with a heading [rad] ± 0.01."""
    zero, P = np.zeros(3), 1e-4 * np.eye(N_ERROR)
    return NavState(np.array([0.5, 0.1, 0.0]), zero, quat_from_rpy(0.0, 0.0, yaw), zero, zero, P)


@pytest.mark.parametrize("nis_scale", [0.5, 4.0])
def test_a_chosen_filter_is_as_uncertain_as_the_mixture_about_it(nis_scale: float) -> None:
    two = MultipleModelBank([level(0.0), level(0.3)], begin, FilterSettings(), np.array([0.6, 0.4]))
    two._nis_scale = nis_scale

    chosen = two._decision(two.best).filter

    (event,) = chosen.events
    assert isinstance(event, FilterChosen)
    assert chosen is two.filters[0] and event.t_ns == chosen.t_ns
    spread = np.sqrt((0.01**2 + 0.6 * 0.4 * 0.3**2) * max(nis_scale, 1.0))
    assert event.std[8] == pytest.approx(np.hypot(spread, 0.4 * 0.3))
    assert not np.delete(event.std, 8).any()


def decide_on(bank: MultipleModelBank, *fixes: PositionFix) -> None:
    """Let all filters have decided on fixes that the bank was given."""
    for fix in fixes:
        bank._waiting[fix.kind, fix.t_ns] = fix
        for one in bank.filters:
            one.verdicts.append(Verdict(fix, True, "", 0.0, 2.0, 21.1, np.ones(3)))


def fix_at(t_ns: int) -> PositionFix:
    return PositionFix(t_ns, np.array([0.5, 0.1, 0.0]), np.eye(3), np.zeros(3))


def test_where_a_motion_begins_each_filter_gets_the_uncertainty_of_its_cell_back(
    bank: MultipleModelBank,
) -> None:
    decide_on(bank, fix_at(SECOND))
    bank.motion.observe = lambda measurement, best: True  # type: ignore[method-assign]

    bank._weigh_decided()

    for one in bank.filters:
        (event,) = one.events  # type: ignore[attr-defined]
        assert isinstance(event, CovarianceInflation)
        assert event.std[8] ** 2 == pytest.approx(HEADING_STD**2 - 0.05**2)


@pytest.mark.parametrize("moves", [True, False])
def test_only_motion_is_evidence_and_beyond_the_gate_all_is_the_same(
    bank: MultipleModelBank, moves: bool
) -> None:
    decide_on(bank, fix_at(SECOND))
    for k, nis in enumerate((2.0, 20.0, 30.0, 3000.0)):
        bank.filters[k].verdicts[0] = replace(bank.filters[k].verdicts[0], nis=nis)
    bank.motion.moves = moves
    bank.motion.observe = lambda measurement, best: False  # type: ignore[method-assign]

    bank._weigh_decided()

    weights = np.exp(bank.log_weights)
    assert (weights[0] > 2.0 * weights[1]) == moves
    assert (weights[1] > weights[2]) == moves
    assert weights[2] == pytest.approx(weights[3])


def test_what_a_filter_has_judged_is_not_told_again_by_those_that_go_on(
    bank: MultipleModelBank,
) -> None:
    judged, waits, alone = fix_at(SECOND), fix_at(2 * SECOND), fix_at(3 * SECOND)
    decide_on(bank, judged, waits)
    running: Any = SimpleNamespace(withdraw=lambda: [waits, alone])

    assert bank.take_over(running) == [alone]

    assert [verdict.measurement for verdict in bank._weigh_decided()] == [waits]


def test_what_the_others_leave_unknown_outlasts_a_late_fix() -> None:
    """
    GIVEN two filters, each sure of another heading, of which one is chosen
    WHEN a fix comes that was valid before that
    THEN the heading of the chosen one is as uncertain as both are together.
    """
    ring, sample = ImuRing(), np.array([0.0, 0.0, -9.8, 0.0, 0.0, 0.0])
    noise = ConstantNoise(np.full(6, 1e-8)), ProcessNoise(np.full(6, 1e-12), 0.01)
    ring.push(SECOND, *sample.tolist())

    def start(state: NavState, settings: FilterSettings) -> InsFilter:
        gate = Gate({3: 16.0}, 3.0)
        return InsFilter(state, SECOND, sample, FilterNoise(*noise), gate, ring, settings)

    two = MultipleModelBank([level(0.0), level(0.3)], start, FilterSettings())
    fly(ring, two.filters, SECOND, 30)
    chosen = two._decision(two.best).filter
    std = np.sqrt(chosen.nav[HEADING_VARIANCE])
    fly(ring, [chosen], chosen.t_ns, 5)

    chosen.submit(fix_at(SECOND + 250_000_000))

    assert chosen.verdicts[-1].accepted
    assert 0.15 < std < 0.25
    assert np.sqrt(chosen.nav[HEADING_VARIANCE]) > 0.99 * std


def fly(ring: ImuRing, filters: list[InsFilter], t_ns: int, count: int) -> None:
    """Let filters follow the IMU of a vehicle that stands, from a stamp [ns] on."""
    for k in range(1, count + 1):
        sample = t_ns + k * SECOND // 100, 0.0, 0.0, -9.8, 0.0, 0.0, 0.0
        ring.push(*sample)
        for one in filters:
            one.predict(*sample)
