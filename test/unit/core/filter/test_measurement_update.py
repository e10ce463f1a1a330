"""What an event leaves in the flat state besides its correction."""

import numpy as np
import pytest

from hybrid_ins.core.aiding.measurements import Heading
from hybrid_ins.core.filter.events import (
    AntennaShift,
    ClockShift,
    CovarianceInflation,
    NoiseChange,
    ScatterInForce,
)
from hybrid_ins.core.filter.filter_noise import FilterNoise
from hybrid_ins.core.filter.measurement_update import MeasurementUpdate
from hybrid_ins.core.imu.samples import ImuRing
from hybrid_ins.core.inertial.earth import displacement
from hybrid_ins.core.inertial.rotations import (
    heading_from_quat,
    matrix_from_quat,
    quat_from_rpy,
)
from hybrid_ins.core.inertial.state import (
    HEADING_DOUBT,
    HEADING_VARIANCE,
    LLA,
    N_ERROR,
    PAST_VARIANCE,
    PSD,
    QUAT,
    SENSITIVITY,
    VELOCITY,
    Array,
    NavState,
    covariance,
    total_std,
    unpack_total,
)
from hybrid_ins.core.noise.heading_information import OF_FILTER, SUMS, VARIANCE
from hybrid_ins.core.noise.multiple_model import NoiseMultipleModelBank
from hybrid_ins.core.noise.position_jumps import PositionJumps
from hybrid_ins.core.noise.position_scatter import PositionScatter
from hybrid_ins.core.noise.process_noise import ConstantNoise, ProcessNoise
from hybrid_ins.core.sensor_errors.clock_offset import ClockOffsetObserver
from hybrid_ins.core.sensor_errors.clock_sensitivity import initial_sensitivity
from hybrid_ins.core.sensor_errors.lever_arm import PARAMETERS, LeverArmObserver
from hybrid_ins.core.sensor_errors.scale_errors import CLOCK, ScaleErrorObserver
from hybrid_ins.core.update.gate import Gate
from hybrid_ins.core.update.measurements import PositionFix, position_model

SECOND = 1_000_000_000
BY_MOTION = 0.3  # rad: σ of a heading of which the filter is surer


@pytest.fixture
def nav() -> Array:
    """Return the flat state of a filter that knows its heading to 0.02 rad."""
    sigma = np.repeat([1.0, 0.3, 0.02, 0.05, 0.005], 3)
    quat, zero = quat_from_rpy(0.1, -0.2, 0.7), np.zeros(3)
    state = NavState(np.array([0.5, 0.1, 50.0]), zero, quat, zero, zero, np.diag(sigma**2))
    return state.to_flat()


@pytest.fixture
def whole(nav: Array) -> MeasurementUpdate:
    """Return what applies events, the last fixes having shown noise of the IMU alone."""
    noise = FilterNoise(ConstantNoise(np.full(6, 1e-3)), ProcessNoise(np.full(6, 1e-6), 0.01))
    gate = Gate({1: 7.0, 2: 9.0, 3: 11.0}, 3.0)
    beside = LeverArmObserver(), ScaleErrorObserver(0.0)
    scatter, clock = PositionScatter(), ClockOffsetObserver(0.3)
    found = MeasurementUpdate(noise, gate, clock, scatter, SECOND, *beside)
    nav[PSD] = noise.psd()
    found.heading.values[SUMS] = 5.0, 6.0
    found.heading.values[VARIANCE] = BY_MOTION**2
    found.heading.values[OF_FILTER] = nav[HEADING_VARIANCE]
    return found


def test_what_motion_does_not_show_is_reported_of_the_heading_alone(
    nav: Array, whole: MeasurementUpdate
) -> None:
    fix = PositionFix(6 * SECOND // 5, nav[:3].copy(), np.eye(3), np.zeros(3))

    outcome = whole.apply(nav, fix, 0.0, False, ImuRing())

    assert outcome.verdict is not None and outcome.verdict.accepted
    total, own = total_std(nav), np.sqrt(covariance(nav).diagonal())
    assert total[8] == pytest.approx(BY_MOTION, rel=1e-3)
    np.testing.assert_array_equal(total[6:8], own[6:8])


def test_another_sensor_shows_the_heading_in_full(nav: Array, whole: MeasurementUpdate) -> None:
    sums, std = whole.heading.values[SUMS].copy(), 0.01
    compass = Heading(6 * SECOND // 5, heading_from_quat(nav[QUAT]), std**2)

    outcome = whole.apply(nav, compass, 0.0, False, ImuRing())

    assert outcome.verdict is not None and outcome.verdict.accepted
    assert total_std(nav)[8] < 1.1 * std
    np.testing.assert_array_equal(whole.heading.values[SUMS], sums)


def test_a_shift_of_the_clock_moves_the_state_and_all_estimates_of_it(
    nav: Array, whole: MeasurementUpdate
) -> None:
    nav[VELOCITY] = 10.0, 0.0, 0.0
    nav[SENSITIVITY] = initial_sensitivity(nav[VELOCITY], np.zeros(3))
    before = nav[LLA].copy()

    whole.apply(nav, ClockShift(SECOND, 0.1), 0.0, False, ImuRing())

    np.testing.assert_allclose(displacement(before, nav[LLA]), [-1.0, 0.0, 0.0], atol=1e-6)
    left = whole.lever_arm._values[PARAMETERS.start], whole.scale_errors._parameters[CLOCK]
    assert (whole.clock.residual, *left) == (-0.1, -0.1, -0.1)


def test_jumps_of_fixes_are_known_to_the_next_filter_and_outlast_other_noise(
    nav: Array, whole: MeasurementUpdate
) -> None:
    z, claimed = np.array([10.0, 0.0, 0.0]), np.diag([1e-4, 1e-4, 1e-4])
    jumps = PositionJumps().learned(z, claimed, claimed, SECOND)
    other = FilterNoise(whole.noise.model, whole.noise.process)

    whole.apply(nav, ScatterInForce(SECOND, jumps), 0.0, False, ImuRing())
    after = nav[PAST_VARIANCE].copy()
    whole.apply(nav, NoiseChange(SECOND, other), 0.0, False, ImuRing())

    assert whole.scatter.in_force and after[0] == pytest.approx(50.0, rel=0.01)
    np.testing.assert_array_equal(nav[PAST_VARIANCE], after)


def test_another_heading_leaves_the_antenna_where_fixes_have_shown_it(
    nav: Array, whole: MeasurementUpdate
) -> None:
    lever_b = np.array([-0.5, 0.2, -0.3])
    for t_ns in SECOND, 2 * SECOND:  # a plain fix, and one that is judged by more than its NIS
        whole.apply(nav, PositionFix(t_ns, nav[LLA], np.eye(3), lever_b), 0.0, False, ImuRing())
    before, after = np.empty((N_ERROR, N_ERROR)), np.empty((N_ERROR, N_ERROR))
    unpack_total(nav, before)
    nav[HEADING_DOUBT] += 0.5**2
    unpack_total(nav, after)

    _, H = position_model(nav, nav[LLA], lever_b)

    np.testing.assert_allclose(H @ after @ H.T, H @ before @ H.T, atol=1e-9)
    assert np.trace(after[:2, :2] - before[:2, :2]) == pytest.approx(
        0.5**2 * np.sum((matrix_from_quat(nav[QUAT]) @ lever_b)[:2] ** 2), rel=0.01
    )
    np.testing.assert_allclose(total_std(nav), np.sqrt(np.diag(after)))


@pytest.mark.parametrize("keeps_weights", [True, False])
def test_what_moves_the_state_restarts_the_hypotheses_on_noise(
    nav: Array, whole: MeasurementUpdate, keeps_weights: bool
) -> None:
    """A fault of the IMU leaves the factors that were found, another antenna does not."""
    bank = NoiseMultipleModelBank()
    whole.noise.factors, bank.estimates = bank, np.zeros(1)
    bank.found = bank.found._replace(accelerometer=9.0)
    std, zero = np.zeros(N_ERROR), np.zeros(3)
    event = (
        CovarianceInflation(SECOND, std, zero)
        if keeps_weights
        else AntennaShift(SECOND, zero, False)
    )

    whole.apply(nav, event, 0.0, False, ImuRing())

    assert bank.estimates is None
    assert bank.found.accelerometer == (9.0 if keeps_weights else 1.0)
    assert (whole.noise.jumps.doubted_ns > SECOND) == keeps_weights
