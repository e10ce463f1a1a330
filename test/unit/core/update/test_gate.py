"""How fixes are weighted, which are rejected, and how the state returns to them."""

import copy

import numpy as np
import pytest

from hybrid_ins.core.update.gate import Gate, Verdict, weight
from hybrid_ins.core.update.measurements import PositionFix, Standstill

R = np.eye(3)
S = 2.0 * np.eye(3)
INTERVAL = 0.5  # s: 10 m is more than an INS drifts by
RNG = np.random.default_rng(0)


def fix(t: float) -> PositionFix:
    return PositionFix(int(t * 1e9), np.zeros(3), R, np.zeros(3))


def judge(gate: Gate, t: float, z: float | np.ndarray, interval: float = INTERVAL) -> Verdict:
    innovation = np.broadcast_to(np.asarray(z, float), 3)
    nis = float(innovation @ np.linalg.solve(S, innovation))
    return gate.judge(fix(t), innovation, R, S, nis, 0.0, interval)


@pytest.fixture
def gate() -> Gate:
    return Gate({2: 18.4, 3: 21.1}, patience=3.0)


def test_sound_fix_is_accepted_with_all_that_was_used(gate: Gate) -> None:
    verdict = judge(gate, 1.0, 0.5)

    assert verdict.accepted and not verdict.inflated and verdict.reason == ""
    assert verdict.nis == pytest.approx(0.375) and verdict.threshold == 21.1
    assert verdict.sigma == pytest.approx([1.0, 1.0, 1.0])
    assert verdict.log_det == pytest.approx(3.0 * np.log(2.0))


def test_one_outlier_is_refused_with_a_reason(gate: Gate) -> None:
    verdict = judge(gate, 1.0, 50.0)

    assert not verdict.accepted and "gate" in verdict.reason
    assert judge(gate, 2.0, 0.1).accepted


def test_other_limits_leave_a_run_of_rejections_as_it_was(gate: Gate) -> None:
    judge(gate, 1.0, 0.1)
    judge(gate, 2.0, 50.0)

    changed = gate.replaced_by(Gate({3: 6.3}, patience=7.0))

    assert changed.rejects(int(2e9)) and changed.threshold(3) == 6.3
    verdicts = [judge(changed, 2.0 + 0.5 * k, 50.0) for k in range(1, 16)]
    assert [v.inflated for v in verdicts] == [False] * 13 + [True] + [False]
    assert gate.threshold(3) == 21.1


def test_large_innovation_that_an_ins_can_make_is_weighted_not_rejected(gate: Gate) -> None:
    verdict = judge(gate, 1.0, 5.0)

    assert verdict.nis > verdict.threshold
    assert verdict.accepted and verdict.reason and 0.1 < verdict.weight < 0.5


def test_what_the_fix_claims_is_no_jump_even_where_it_scatters_by_less(gate: Gate) -> None:
    scatter, z = 0.05**2 * R, np.full(3, 2.0)

    def at_scatter(claimed: np.ndarray | None) -> Verdict:
        rest = copy.copy(gate)
        return rest.judge(fix(1.0), z, scatter, 2.0 * scatter, 2400.0, 0.0, INTERVAL, claimed)

    assert not at_scatter(None).accepted and not at_scatter(0.2**2 * R).accepted
    within = at_scatter(R)
    assert within.accepted and within.weight < 0.01 and within.sigma == pytest.approx([0.05] * 3)


def test_weight_is_one_for_ordinary_innovations_and_falls_without_a_step() -> None:
    nis = np.linspace(0.0, 1000.0, 100_001)
    weights = np.array([weight(float(v), 3) for v in nis])

    assert np.all(weights[nis < 7.8] == 1.0)
    assert np.all(np.diff(weights) <= 0.0)
    assert np.abs(np.diff(weights)).max() < 2e-3
    # The pull of a measurement, its weight times its size, falls for large ones.
    assert weights[-1] * np.sqrt(nis[-1]) < 0.1 * np.sqrt(7.8)


def test_jump_within_a_run_of_large_innovations_is_rejected(gate: Gate) -> None:
    judge(gate, 1.0, 5.0)

    assert not judge(gate, 1.5, 50.0).accepted


def test_noise_beyond_the_claim_is_no_jump_until_it_has_calmed(gate: Gate) -> None:
    for t, z in ((0.0, 5.0), (0.5, -8.0)):
        judge(gate, t, z)

    noisy = [judge(gate, 1.0 + 0.5 * k, (-1.0) ** k * 12.0) for k in range(4)]
    calm = [judge(gate, 3.0 + 0.5 * k, 0.5) for k in range(20)]

    assert all(v.accepted and v.weight < 0.1 for v in noisy)
    assert all(v.accepted and v.weight == 1.0 for v in calm)
    assert not judge(gate, 13.0, 12.0).accepted


def test_fixes_that_agree_win_after_the_patience(gate: Gate) -> None:
    verdicts = [judge(gate, t, 50.0 + 0.1 * t) for t in np.arange(0.0, 4.0, 0.5)]

    assert [v.accepted for v in verdicts[:6]] == [False] * 6
    assert verdicts[6].accepted and verdicts[6].inflated and "3.0 s" in verdicts[6].reason
    assert not verdicts[7].accepted  # and from there on as before


def test_a_reset_after_a_jump_of_fixes_that_agreed_before_is_the_receivers(gate: Gate) -> None:
    """
    GIVEN fixes that agreed with the state for longer than the patience, or not
    WHEN they jump, or drift off as a wrong state does, until the covariance is inflated
    THEN the receiver jumped where they agreed before and no error of an INS is so fast.
    """

    def reset(agreed: float, first: float, drift: float) -> Verdict:
        twin = copy.copy(gate)
        judge(twin, 0.0, 0.1, interval=20.0)  # after a pause
        for t in np.arange(0.5, agreed, 0.5):
            judge(twin, t, 0.1)
        later = np.arange(agreed, agreed + 12.0, 0.5)
        verdicts = [judge(twin, t, min(50.0, first + drift * (t - agreed))) for t in later]
        return next(v for v in verdicts if v.inflated)

    assert reset(10.0, 50.0, 0.0).receiver_jumped
    assert not reset(10.0, 4.0, 5.0).receiver_jumped
    assert not reset(1.0, 50.0, 0.0).receiver_jumped


@pytest.mark.parametrize(
    ("ramp", "gap", "jumped", "ambiguous"),
    [
        (1.5, 0.5, True, False),  # s
        (4.0, 0.5, False, True),  # it still grows, as an error of the state would
        (1.5, 3.0, False, True),  # as large as an error of the state may be by then
        (1.5, 4.0, False, False),  # a pause: the state is not believed
    ],
)
def test_fixes_that_glide_off_and_stay_there_have_jumped(
    gate: Gate, ramp: float, gap: float, jumped: bool, ambiguous: bool
) -> None:
    judge(gate, 0.0, 0.1, interval=20.0)
    for t in np.arange(0.5, 10.0, 0.5):
        judge(gate, t, 0.1)

    gone = np.arange(0.5, 10.0, 0.5)
    first = 9.5 + gap
    verdicts = [
        judge(gate, first + t - 0.5, min(1.0, t / ramp) * 20.0, interval=max(gap, t)) for t in gone
    ]

    opened = next(v for v in verdicts if v.inflated)
    assert (opened.receiver_jumped, opened.is_ambiguous) == (jumped, ambiguous)


@pytest.mark.parametrize(
    ("before", "first", "second", "jumped"),
    [
        (0.01, 1.5, 1.55, True),
        (0.01, 1.5, 3.0, False),  # as an error of an INS grows
        (0.01, 0.9, 0.9, False),  # as one may be after a second
        (0.4, 1.5, 1.55, False),  # the innovations were large before
    ],
)
def test_two_large_innovations_that_are_alike_are_a_jump_of_the_receiver(
    gate: Gate, before: float, first: float, second: float, jumped: bool
) -> None:
    def judge_precise(t: float, z: float) -> Verdict:
        innovation, R = np.full(3, z), 0.01 * np.eye(3)
        return gate.judge(fix(t), innovation, R, 2.0 * R, 150.0 * z**2, 0.0, 1.0)

    for k in range(10):
        judge_precise(float(k), 0.05 if k % 2 else before)

    verdicts = [judge_precise(10.0 + k, z) for k, z in enumerate((first, second, second))]

    assert [v.receiver_jumped for v in verdicts] == [False, jumped, False]
    assert all(v.accepted and not v.inflated for v in verdicts)


def test_shift_that_grows_is_agreement(gate: Gate) -> None:
    verdicts = [judge(gate, t, 10.0 + 10.0 * t) for t in np.arange(0.0, 4.0, 1.0)]

    assert verdicts[-1].inflated


def test_fixes_that_contradict_each_other_wait_longer_but_not_for_ever(gate: Gate) -> None:
    verdicts = [judge(gate, t, RNG.normal(0.0, 100.0, 3)) for t in np.arange(0.0, 9.5, 0.5)]

    assert not any(v.accepted for v in verdicts[:12])
    assert any(v.inflated for v in verdicts)


def test_jumps_are_evidence_on_the_fixes_where_they_disagree(gate: Gate) -> None:
    same = [judge(gate, t, 50.0 + 0.1 * t) for t in (0.0, 0.5, 1.0)]
    other = judge(gate, 1.5, -60.0)

    assert [v.disagrees for v in same] == [True, False, False]
    assert other.jump and other.disagrees


def test_acceptance_in_between_starts_the_patience_anew(gate: Gate) -> None:
    for t in (0.0, 1.0, 2.0):
        judge(gate, t, 50.0)
    judge(gate, 2.5, 0.0)

    assert not judge(gate, 3.5, 50.0).accepted
    assert not judge(gate, 6.0, 50.0).accepted
    assert judge(gate, 6.5, 50.0).inflated


def test_fix_that_barely_fits_after_rejections_that_agree_opens_the_state(gate: Gate) -> None:
    """The covariance has grown until the tail of its distribution reached them: that is no fit."""
    for t in np.arange(0.0, 2.0, 0.2):
        assert judge(gate, t, 5.0).weight < 1.0
    twin = copy.copy(gate)

    barely = judge(gate, 2.0, 3.0)
    well = judge(twin, 2.0, 1.0)

    assert barely.nis < barely.threshold and barely.inflated
    assert well.accepted and not well.inflated
    alone = Gate({3: 21.1}, patience=3.0)
    judge(alone, 0.0, 5.0)
    assert not judge(alone, 0.2, 3.0).inflated


def test_kinds_are_judged_apart(gate: Gate) -> None:
    judge(gate, 0.0, 50.0)
    still = Standstill(int(4e9), np.zeros(3), np.ones(3))

    verdict = gate.judge(still, np.full(3, 50.0), R, S, 9e3, 0.0)

    assert not verdict.accepted


def test_standstill_never_opens_the_state(gate: Gate) -> None:
    for t in range(60):
        still = Standstill(t * 1_000_000_000, np.zeros(3), np.ones(3))
        assert not gate.judge(still, np.full(3, 50.0), R, S, 9e3, 0.0).accepted


def test_copy_does_not_share_its_memory(gate: Gate) -> None:
    judge(gate, 0.0, 50.0)
    twin = copy.copy(gate)
    judge(gate, 1.0, 0.0)

    assert judge(twin, 3.0, 50.0).inflated
    assert not judge(gate, 3.0, 50.0).accepted


PAUSE = 20.0  # s, in which an INS may drift by more than any of these innovations


def test_after_a_pause_a_fix_above_the_threshold_waits_for_one_that_agrees(gate: Gate) -> None:
    alone = judge(gate, 20.0, 30.0, PAUSE)
    twin = copy.copy(gate)
    right = judge(copy.copy(gate), 20.2, 0.5, PAUSE)
    second = judge(gate, 20.2, 30.5, PAUSE)

    assert not alone.accepted and alone.reason and not alone.disagrees
    assert right.accepted and right.weight == 1.0
    assert second.inflated and second.weight == 1.0
    assert not second.receiver_jumped and not second.is_ambiguous  # it was the state
    disagreeing = judge(copy.copy(twin), 20.2, -30.5, PAUSE)
    assert not disagreeing.accepted


def test_a_jump_after_a_pause_has_to_last_also_where_the_next_one_agrees(gate: Gate) -> None:
    """No error of an INS is 3 km in 20 s: two wrong fixes do not take the state with them."""
    verdicts = [judge(gate, 20.0 + 0.2 * k, 3000.0, PAUSE + 0.2 * k) for k in range(5)]

    assert not any(verdict.accepted for verdict in verdicts)


def test_a_state_that_rests_on_one_fix_is_left_sooner(gate: Gate) -> None:
    """GIVEN a pause that an outlier ended WHEN fixes agree elsewhere THEN a second is enough."""
    assert judge(gate, 20.0, 1.0, PAUSE).accepted

    verdicts = [judge(gate, 20.2 + 0.2 * k, 50.0) for k in range(6)]

    assert not any(v.accepted for v in verdicts[:5])
    assert verdicts[5].inflated


def test_a_state_that_was_confirmed_as_long_as_the_patience_is_not(gate: Gate) -> None:
    judge(gate, 20.0, 1.0, PAUSE)
    for k in range(1, 20):
        judge(gate, 20.0 + 0.2 * k, 1.0)

    assert not any(judge(gate, 24.0 + 0.2 * k, 50.0).accepted for k in range(15))
    assert judge(gate, 27.0, 50.0).inflated


def test_it_tells_of_a_jump_until_a_fix_agrees(gate: Gate) -> None:
    assert not gate.rejects(0)
    judge(gate, 0.0, 5.0)  # weighted: an INS may be so far off
    assert not gate.rejects(0)
    judge(gate, 0.2, 0.0)
    judge(gate, 0.4, 50.0)
    assert gate.rejects(int(0.4e9))
    judge(gate, 0.6, 0.0)
    assert not gate.rejects(int(0.6e9))


def test_what_comes_no_more_is_rejected_no_more(gate: Gate) -> None:
    judge(gate, 0.2, 0.0)
    judge(gate, 0.4, 50.0)

    assert gate.rejects(int(3.4e9)) and not gate.rejects(int(3.5e9))


def test_an_outage_ends_a_run_of_rejections(gate: Gate) -> None:
    """GIVEN a fix rejected before an outage WHEN the first after it is far off THEN it waits."""
    judge(gate, 1.0, 0.1)
    judge(gate, 1.5, 50.0)

    first = judge(gate, 21.5, 400.0, interval=20.5)
    assert not first.accepted and not first.inflated
    assert judge(gate, 22.0, 0.1, interval=21.0).accepted


def test_rare_fixes_are_followed_after_three_that_agree(gate: Gate) -> None:
    """GIVEN fixes rarer than the patience THEN the pauses between them do not end their run."""
    judge(gate, 0.0, 0.1, interval=10.0)

    verdicts = [judge(gate, 10.0 * k, 3000.0, interval=10.0 * k) for k in (1, 2, 3)]

    assert any(verdict.inflated for verdict in verdicts)


def test_a_run_of_rejections_is_no_pause(gate: Gate) -> None:
    """GIVEN fixes that were rejected until the state was opened THEN it is left no sooner again."""
    opened = [judge(gate, 0.2 * k, 50.0, 0.2 * (k + 1)) for k in range(16)]
    assert opened[-1].inflated and not any(v.accepted for v in opened[:-1])

    again = [judge(gate, 3.2 + 0.2 * k, 50.0, 0.2 * (k + 1)) for k in range(15)]

    assert not any(v.accepted for v in again)
