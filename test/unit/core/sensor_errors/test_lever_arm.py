"""The error of the lever arm: the sensitivity is the filter's own, and sigma holds the error."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.analytic_motion import difference
from support.runs import begin

from hybrid_ins.core.filter.events import AntennaFound, AntennaShift
from hybrid_ins.core.filter.ins_filter import InsFilter
from hybrid_ins.core.inertial import propagation
from hybrid_ins.core.inertial.rotations import (
    matrix_from_quat,
    quat_from_rotvec,
    quat_from_rpy,
    quat_multiply,
    skew,
)
from hybrid_ins.core.inertial.state import (
    ANTENNA_VARIANCE,
    BIAS_G,
    CLOCK_VARIANCE,
    COVARIANCE,
    DV,
    EPS,
    HEADING_VARIANCE,
    N_ERROR,
    PAST_VARIANCE,
    QUAT,
    covariance,
    total_std,
    unpack_total,
)
from hybrid_ins.core.sensor_errors.clock_offset import MAX_STD
from hybrid_ins.core.sensor_errors.lever_arm import (
    _START,
    P_PARAMETERS,
    SENSITIVITIES,
    LeverArmObserver,
    dependence_on_lever_arm,
    observe_lever_arm,
)
from hybrid_ins.core.update.measurements import VelocityFix
from hybrid_ins.simulation.motions import car_drive
from tools.paper.runs import Run, Scenario, draw

DRIVE = Scenario("drive", car_drive, rate=100.0, duration=90.0, scored_from=0.6)
FLIGHT = Scenario("flight", rate=100.0, duration=30.0, scored_from=0.6)


def filtered(
    run: Run, lever_b: np.ndarray, *, velocities: bool = False, is_placed: bool = True
) -> InsFilter:
    """Run a filter until the last fix, by which the antenna is at ``lever_b`` from the IMU."""
    ins = begin(run)
    ins.update.lever_arm = LeverArmObserver(is_placed=is_placed)
    ins.ring.extend(run.samples)
    fixes = [replace(fix, lever_b=lever_b) for fix in run.fixes]
    for k in range(2, len(run.scored), 3) if velocities else ():
        t_ns = int(run.samples["t_ns"][run.scored[k]])
        fixes.append(VelocityFix(t_ns, run.velocity_n[k], 0.01 * np.eye(3), lever_b))
    for fix in sorted(fixes, key=lambda fix: fix.t_ns):
        ins.submit(fix)
    last = int(np.searchsorted(run.samples["t_ns"], fixes[-1].t_ns, side="right"))
    ins.predict_block(run.samples[1:last])
    return ins


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize(("fix_rate", "velocities"), [(5.0, False), (5.0, True), (1.0, False)])
def test_sensitivity_is_the_derivative_of_the_filter_by_the_lever_arm(
    axis: int, fix_rate: float, velocities: bool
) -> None:
    run = draw(replace(FLIGHT, fix_rate=fix_rate), 1)
    run = replace(run, fixes=run.fixes[1:-1])
    error = 1e-3 * np.eye(3)[axis]
    right = filtered(run, np.zeros(3), velocities=velocities)
    wrong = filtered(run, -error, velocities=velocities)
    s = right.update.lever_arm._values[SENSITIVITIES].reshape(N_ERROR, 3)[:, axis]
    sigma = np.sqrt(np.diag(right.state.P))

    by_difference = difference(right.nav, wrong.nav) / 1e-3

    assert np.linalg.norm(s / sigma) > 1.0
    assert np.linalg.norm((by_difference - s) / sigma) < 0.1 * np.linalg.norm(s / sigma)


def test_an_antenna_elsewhere_is_found_with_an_honest_sigma() -> None:
    """Errors of many flights over their covariance are chi-square, and no right place is blamed."""
    error_b, squares, wrong, right = np.array([0.4, -0.2, 0.3]), [], [], []
    for seed in range(20):
        run = draw(FLIGHT, seed)
        found = filtered(run, -error_b).lever_arm
        squares.append(np.square((found.error_b - error_b) / found.std))
        wrong.append(found.distance)
        right.append(filtered(run, np.zeros(3)).lever_arm.distance)

    assert 0.3 < np.mean(squares) < 1.3  # its standard deviations are 1.2 times larger
    assert np.median(wrong) > 6.0
    assert max(right) < 4.0


def test_an_error_that_is_certain_is_part_of_the_covariance_that_is_reported() -> None:
    error_b = np.array([1.5, -0.5, 0.8])
    ins = filtered(draw(FLIGHT, 1), -error_b)
    found = ins.lever_arm
    total = np.empty((N_ERROR, N_ERROR))
    ins.nav[CLOCK_VARIANCE], ins.nav[PAST_VARIANCE] = 0.0, 0.0
    unpack_total(ins.nav, total)
    added = total - covariance(ins.nav)

    assert found.is_certain
    C_nb = matrix_from_quat(ins.nav[QUAT])
    of_error = np.square(C_nb @ found.error_b)
    np.testing.assert_array_less(of_error, np.diag(added)[:3])
    np.testing.assert_allclose(np.diag(added)[:3], of_error, atol=2.0 * np.max(found.std) ** 2)
    s = ins.update.lever_arm._values[SENSITIVITIES].reshape(N_ERROR, 3)[EPS]
    of_attitude = np.square(s @ found.error_b)
    assert of_attitude.max() > np.radians(0.3) ** 2
    np.testing.assert_array_less(of_attitude, np.diag(added)[EPS])
    assert not np.diag(added)[[3, 4, 5, *range(9, N_ERROR)]].any()


def test_an_error_is_considered_before_it_is_worth_telling() -> None:
    """GIVEN a flight that begins, and an antenna elsewhere THEN first the covariance holds it."""
    run = draw(FLIGHT, 1)
    considered, told = [], []
    for seconds in np.arange(8.0, 31.0):
        stop_ns = int(run.samples["t_ns"][0] + seconds * 1e9)
        begun = replace(run, fixes=tuple(fix for fix in run.fixes if fix.t_ns < stop_ns))
        found = filtered(begun, -np.array([0.6, -0.2, 0.3]))
        if np.any(found.nav[ANTENNA_VARIANCE]):
            considered.append(seconds)
        if found.lever_arm.is_certain:
            told.append(seconds)

    assert considered and told and considered[0] < told[0]


def test_a_correction_undoes_what_the_error_has_done_to_the_state() -> None:
    error_b = np.array([0.03, -0.02, 0.02])
    run = draw(FLIGHT, 1)
    right, wrong = filtered(run, np.zeros(3)), filtered(run, -error_b)
    sigma = np.sqrt(np.diag(right.state.P))
    before = np.linalg.norm(difference(right.nav, wrong.nav) / sigma)

    wrong.submit(AntennaShift(wrong.t_ns, error_b, True))

    assert before > 1.0
    assert np.linalg.norm(difference(right.nav, wrong.nav) / sigma) < 0.15 * before


@pytest.mark.parametrize("moves_odometry", [True, False])
def test_after_a_correction_what_is_left_is_considered_or_all_of_it(moves_odometry: bool) -> None:
    ins = filtered(draw(FLIGHT, 1), -np.array([0.9, -0.3, 0.5]))
    found = ins.lever_arm

    ins.submit(AntennaShift(ins.t_ns, found.error_b, moves_odometry))

    left, distance = ins.lever_arm, np.linalg.norm(found.error_b)
    np.testing.assert_allclose(left.error_b, 0.0, atol=0.05)  # the last fix is of that stamp
    assert np.all(left.std > found.std) and not left.is_certain
    considered = np.sqrt(np.sum(ins.nav[ANTENNA_VARIANCE]))
    assert considered < 0.8 * distance if moves_odometry else considered > 0.9 * distance
    # AND a filter that begins later, with the lever arm that was found, considers as much
    begun = LeverArmObserver(found.std).or_earlier(ins.update.lever_arm)
    later = np.sqrt(np.max(begun.considered(ins.nav)))
    assert later < 0.8 * distance if moves_odometry else later > 0.9 * distance


def test_what_is_not_known_of_a_place_that_was_found_is_not_known_of_the_attitude() -> None:
    ins = filtered(draw(FLIGHT, 1), -np.array([0.9, -0.3, 0.5]))

    ins.submit(AntennaShift(ins.t_ns, ins.lever_arm.error_b, True))

    left = ins.lever_arm
    s = ins.update.lever_arm._values[SENSITIVITIES].reshape(N_ERROR, 3)[EPS]
    V = (1.44 * ins.update.lever_arm._values[P_PARAMETERS].reshape(5, 5))[2:, 2:]
    of_place = np.diag(s @ (V + np.outer(left.error_b, left.error_b)) @ s.T)
    assert of_place.max() > np.radians(0.1) ** 2
    added = np.square(total_std(ins.nav)) - np.diag(covariance(ins.nav))
    np.testing.assert_array_less(0.99 * of_place, added[EPS])


@pytest.mark.parametrize("is_placed", [True, False])
def test_of_an_antenna_that_nobody_placed_the_first_seconds_are_forgotten(is_placed: bool) -> None:
    run, std = draw(FLIGHT, 1), []
    for seconds in (10.2, 10.6):
        stop_ns = run.fixes[0].t_ns + round(seconds * 1e9)
        begun = replace(run, fixes=tuple(fix for fix in run.fixes if fix.t_ns < stop_ns))
        std.append(filtered(begun, np.zeros(3), is_placed=is_placed).lever_arm.std)

    assert np.all(std[1] < std[0]) if is_placed else std[1][2] > 2.0 * std[0][2]


def test_what_the_clock_does_is_no_lever_arm() -> None:
    late = 0.2
    run = draw(DRIVE, 3)
    fixes = tuple(replace(fix, t_ns=fix.t_ns - round(late * 1e9)) for fix in run.fixes[2:])
    run = replace(run, fixes=fixes)

    assert filtered(run, np.zeros(3)).lever_arm.distance < 2.5


def test_what_one_filter_has_found_is_the_prior_of_the_next() -> None:
    """
    GIVEN a filter that has found an antenna elsewhere
    WHEN another one begins
    THEN it considers that error from the start, in any direction, and goes on from it.
    """
    run = draw(FLIGHT, 1)
    earlier = filtered(run, -np.array([0.6, -0.2, 0.3]))
    known = earlier.lever_arm
    begun = begin(run)
    begun.submit(AntennaFound(begun.t_ns, earlier.update.lever_arm))

    assert known.is_certain and begun.lever_arm.is_certain
    np.testing.assert_array_equal(begun.lever_arm.error_b, known.error_b)
    np.testing.assert_allclose(begun.lever_arm.std, known.std)
    total = earlier.nav[ANTENNA_VARIANCE].sum()
    np.testing.assert_allclose(begun.nav[ANTENNA_VARIANCE], np.full(3, total))
    assert begun.update.lever_arm._values[P_PARAMETERS][:5].tolist() == [MAX_STD**2, 0, 0, 0, 0]


def test_an_earlier_finding_comes_too_late_for_a_filter_that_has_its_own() -> None:
    run = draw(FLIGHT, 1)
    earlier, running = filtered(run, -np.array([0.6, -0.2, 0.3])), filtered(run, np.zeros(3))
    own = running.lever_arm.error_b
    running.submit(AntennaFound(running.t_ns, earlier.update.lever_arm))

    np.testing.assert_array_equal(running.lever_arm.error_b, own)
    assert not running.lever_arm.is_certain


def test_the_uncertainty_of_a_place_counts_in_its_own_direction() -> None:
    observer, nav = LeverArmObserver(np.array([0.1, 0.01, 0.5])), begin(draw(FLIGHT, 1)).nav.copy()
    nav[QUAT] = quat_from_rpy(0.0, 0.0, 0.5 * np.pi)  # it heads east
    nav[HEADING_VARIANCE] = 1e-4
    north, east, down = np.sqrt(observer.considered(nav))
    nav[HEADING_VARIANCE] = 1.0
    anywhere = np.sqrt(observer.considered(nav))

    assert (east / north, down / north) == pytest.approx((10.0, 50.0))
    assert anywhere[0] == anywhere[1] == pytest.approx(np.hypot(north, east))
    assert anywhere[2] == down


def observed(values: np.ndarray, T: float, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Observe an innovation of a position that is zero; return the covariance of the error."""
    H, S = np.eye(3, N_ERROR), 1e-4 * np.eye(3)
    K = np.zeros((N_ERROR, 3))
    observe_lever_arm(values, T, before, after, np.zeros(3), H, K, S, 1.0, True, True)
    return values[P_PARAMETERS].reshape(5, 5)[2:, 2:].copy()


def test_a_corrected_heading_is_no_turn_that_shows_where_the_antenna_is() -> None:
    before = draw(DRIVE, 1).start.to_flat()
    before[COVARIANCE] = 0.0
    after, values = before.copy(), _START.copy()
    after[QUAT] = quat_multiply(quat_from_rotvec([0.0, 0.0, np.radians(8.0)]), before[QUAT])

    known = observed(values, -1.0, before, after)
    corrected = observed(values, 0.2, after, after)

    np.testing.assert_allclose(corrected, known, atol=1e-3)
    # AND a turn is one
    turned = observed(values, 0.2, before, before)
    assert np.linalg.eigvalsh(turned)[0] < 0.01 * np.linalg.eigvalsh(known)[0]


def test_vibration_of_the_gyroscopes_is_no_turn_to_a_velocity() -> None:
    nav = draw(DRIVE, 1).start.to_flat()
    H = np.zeros((3, N_ERROR))
    H[:, DV] = np.eye(3)
    for k in range(400):  # 0.3 rad/s at 200 Hz, and 0.5 rad/s that alternate
        propagation.step(nav, 0.005, 0.0, 0.0, -9.8, 0.5 * (-1.0) ** k, 0.0, 0.3, 0.01)

    of_itself = dependence_on_lever_arm(nav, H)

    swing = matrix_from_quat(nav[QUAT]) @ skew([0.0, 0.0, 0.3] - nav[BIAS_G])
    np.testing.assert_allclose(of_itself, swing, atol=0.03)
