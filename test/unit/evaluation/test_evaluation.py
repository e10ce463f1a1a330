"""The evaluation: figures with analytic answers, what is scored, and what is refused."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from support.recordings import (
    DATUM,
    FAST,
    START_NS,
    TRUTH,
    flight,
    shifted,
    stamps,
    verdicts,
    with_sigma,
)

from hybrid_ins.core.inertial import rotations
from hybrid_ins.core.inertial.earth import LocalFrame
from hybrid_ins.errors import InputError
from hybrid_ins.evaluation.evaluate import evaluate, outage_spans
from hybrid_ins.evaluation.result import Result, Scoring
from hybrid_ins.evaluation.table import summary, table
from hybrid_ins.ros.messages.trajectory import Trajectory


class TestFigures:
    def test_a_constant_error_of_3_4_0(self) -> None:
        result = evaluate(shifted(flight(FAST), [-3.0, -4.0, 0.0]), flight(TRUTH))

        assert result.prmse == pytest.approx(5.0)
        assert result.pmae == pytest.approx(7.0)
        assert result.horizontal_rmse == pytest.approx(5.0)
        assert result.vertical_rmse == pytest.approx(0.0, abs=1e-9)
        assert result.largest_error == pytest.approx(5.0)
        assert result.velocity_rmse == pytest.approx(0.0, abs=1e-9)
        assert result.attitude_rmse == pytest.approx(0.0, abs=1e-9)
        assert result.errors is not None
        assert result.errors.position_enu[0] == pytest.approx([3.0, 4.0, 0.0])  # true - estimate

    def test_velocity_and_attitude(self) -> None:
        tilt = rotations.quat_from_rotvec(np.array([0.0, 0.03, 0.04]))  # about north and up
        estimate = flight(FAST)
        assert estimate.velocity_enu is not None
        assert estimate.quat_xyzw is not None
        estimate = replace(
            estimate,
            velocity_enu=estimate.velocity_enu + np.array([0.0, 0.3, 0.4]),
            quat_xyzw=rotations.quat_multiply(tilt, estimate.quat_xyzw),
        )

        result = evaluate(estimate, flight(TRUTH))

        assert result.velocity_rmse == pytest.approx(0.5)
        assert result.attitude_rmse == pytest.approx(0.05)
        assert result.heading_rmse == pytest.approx(0.04)
        assert result.tilt_rmse == pytest.approx(0.03)
        # C_true = (I - [eps x]) C_estimated
        assert result.errors is not None
        assert result.errors.rotation_enu is not None
        eps = result.errors.rotation_enu[0]
        assert eps == pytest.approx([0.0, 0.03, 0.04])

    def test_heading_errors_wrap(self) -> None:
        truth, estimate = flight(TRUTH), flight(FAST)
        yaw = rotations.quat_from_rpy(0.0, 0.0, np.radians(179.0))
        back = rotations.quat_from_rpy(0.0, 0.0, np.radians(-179.0))
        truth = replace(truth, quat_xyzw=np.tile(yaw, (len(truth), 1)))
        estimate = replace(estimate, quat_xyzw=np.tile(-back, (len(estimate), 1)))

        result = evaluate(estimate, truth)

        assert result.heading_rmse == pytest.approx(np.radians(2.0))

    def test_a_right_covariance_is_consistent_and_a_small_one_is_not(self) -> None:
        rng = np.random.default_rng(0)
        truth = flight(TRUTH)
        noise = 0.2 * rng.standard_normal((3, len(truth), 3))
        assert truth.velocity_enu is not None
        assert truth.quat_xyzw is not None
        estimate = replace(
            shifted(truth, noise[0]),
            velocity_enu=truth.velocity_enu + noise[1],
            quat_xyzw=rotations.quat_multiply(
                rotations.quat_from_rotvec(0.1 * noise[2]), truth.quat_xyzw
            ),
        )
        cov = np.tile(0.04 * np.eye(3), (len(truth), 1, 1))
        # At 10 m/s an uncertain attitude makes the velocity along one's own axes uncertain, too:
        # not along its motion, which is to its right (east, with the nose to the north).
        twist_cov = cov + 100.0 * 0.01 * np.diag([0.04, 0.0, 0.04])
        honest = replace(
            estimate, position_cov=cov, velocity_cov=twist_cov, attitude_cov=0.01 * cov
        )
        proud = replace(
            honest, position_cov=cov / 4, velocity_cov=twist_cov / 4, attitude_cov=cov / 400
        )

        right, wrong = evaluate(honest, truth), evaluate(proud, truth)

        for part in ("nees_position", "nees_velocity", "nees_attitude"):
            good, bad = getattr(right, part), getattr(wrong, part)
            assert good.dof == 3
            assert good.band[0] < good.per_dof < good.band[1], part
            assert good.verdict == "consistent"
            assert bad.per_dof == pytest.approx(4.0 * good.per_dof)
            assert bad.verdict == "overconfident"

    def test_nis_of_accepted_fixes_beside_that_of_all_tested(self) -> None:
        at = np.arange(0.05, 20.0, 0.2)
        nis = np.full(len(at), 3.0)
        accepted = np.ones(len(at), bool)
        nis[10], accepted[10] = 300.0, False
        nis[20], accepted[20] = np.nan, False
        reasons = np.where(accepted, "", np.where(np.isnan(nis), "no covariance", "gate"))

        result = evaluate(
            flight(FAST),
            flight(TRUTH),
            verdicts=verdicts(at, nis=nis, accepted=accepted, reason=reasons),
        )

        assert result.nis_position is not None
        assert result.nis_position.per_dof == pytest.approx(1.0)
        assert result.nis_position.count == 98
        assert result.nis_tested is not None
        assert result.nis_tested.mean == pytest.approx((98 * 3.0 + 300.0) / 99)
        assert result.fixes is not None
        assert (result.fixes.total, result.fixes.accepted) == (100, 98)
        assert result.fixes.refused == {"gate": 1, "no covariance": 1}
        assert any("rejected" in note for note in result.notes)

    def test_an_uncalibrated_clock_is_not_called_consistent(self) -> None:
        # GIVEN fixes whose NIS is 1.35 per degree of freedom and swings with the vehicle's turns
        at = np.arange(0.05, 40.0, 0.25)
        nis = 3.0 * 1.35 * (1.0 + 0.8 * np.sin(at * 2.0 * np.pi / 20.0))

        result = evaluate(flight(np.arange(0.0, 41.0, 0.01)), None, verdicts=verdicts(at, nis=nis))

        assert result.nis_position is not None
        assert result.nis_position.per_dof == pytest.approx(1.35, abs=0.01)
        assert result.nis_position.verdict == "overconfident"
        assert any("clock offset, lever arm" in note for note in result.notes)

    def test_velocity_fixes_have_a_nis_of_their_own(self) -> None:
        at = np.arange(0.05, 20.0, 0.5)
        kinds = np.where(np.arange(len(at)) % 2, "velocity", "position")
        nis = np.where(kinds == "velocity", 6.0, 3.0)

        result = evaluate(flight(FAST), flight(TRUTH), verdicts=verdicts(at, kind=kinds, nis=nis))

        assert result.nis_position is not None
        assert result.nis_velocity is not None
        assert result.nis_position.per_dof == pytest.approx(1.0)
        assert result.nis_velocity.per_dof == pytest.approx(2.0)
        assert result.fixes is not None
        assert result.fixes.total == 20


class TestTime:
    def test_a_shift_of_0_1_s_at_10_m_per_s_is_1_m_and_vanishes_with_the_offset(self) -> None:
        # GIVEN an estimate whose clock is 0.1 s ahead of the reference's
        estimate = flight(FAST)
        estimate = replace(estimate, stamp_ns=estimate.stamp_ns + 100_000_000)

        ignored = evaluate(estimate, flight(TRUTH), scoring=Scoring(time_offset=0.0))
        option = evaluate(estimate, flight(TRUTH), scoring=Scoring(time_offset=0.1))
        at = np.arange(0.05, 20.0, 0.2)
        said = evaluate(
            estimate, flight(TRUTH), verdicts=verdicts(at, time_offset=np.full(len(at), 0.1))
        )

        assert ignored.prmse == pytest.approx(1.0)
        assert option.prmse == pytest.approx(0.0, abs=1e-9)
        assert said.prmse == pytest.approx(0.0, abs=1e-9)
        assert (ignored.time_offset.source, said.time_offset.source) == ("option", "verdicts")
        assert said.time_offset.mean == pytest.approx(0.1)

    def test_truth_of_the_imus_clock_is_not_shifted(self) -> None:
        # GIVEN fixes stamped 0.1 s behind the IMU's clock, which estimate and truth share
        at = np.arange(0.05, 20.0, 0.2) - 0.1
        known = verdicts(at, time_offset=np.full(len(at), 0.1))

        result = evaluate(
            flight(FAST), flight(TRUTH + 0.05), verdicts=known, scoring=Scoring(truth_clock="imu")
        )

        assert result.prmse == pytest.approx(0.0, abs=1e-9)
        assert result.time_offset.mean == pytest.approx(0.1)  # of the fixes
        assert result.epochs is not None
        assert result.epochs.fed == 100  # where the fixes are in the IMU's clock
        assert any("fix stamps shifted by +0.1000 s" in line for line in table(result).split("\n"))

    def test_an_offset_that_is_learned_in_flight_counts_from_when_it_is_in_force(self) -> None:
        estimate = flight(FAST)
        at = np.array([0.05, 9.95])

        result = evaluate(
            estimate, flight(TRUTH), verdicts=verdicts(at, time_offset=np.array([0.0, -0.05]))
        )

        assert result.errors is not None
        east = result.errors.position_enu[:, 0]
        assert east[:99] == pytest.approx(0.0, abs=1e-9)
        assert east[101:] == pytest.approx(0.5)
        assert (result.time_offset.low, result.time_offset.high) == (-0.05, 0.0)

    def test_epochs_between_estimates_are_interpolated(self) -> None:
        result = evaluate(flight(np.arange(0.0, 20.1, 0.13)), flight(TRUTH))

        assert result.prmse == pytest.approx(0.0, abs=1e-7)
        assert result.largest_gap == pytest.approx(0.13)

    def test_no_time_in_common_names_both_times(self) -> None:
        late = replace(flight(TRUTH), stamp_ns=flight(TRUTH).stamp_ns + 10**12)

        with pytest.raises(InputError, match=r"1700000000\.000 to .*1700001000\.000 to"):
            evaluate(flight(FAST), late)

    def test_start_end_and_skip(self) -> None:
        window = Scoring(start=5.0, end=15.0, skip=2.0)

        result = evaluate(flight(np.arange(4.0, 20.0, 0.01)), flight(TRUTH), scoring=window)

        assert result.epochs is not None
        assert result.epochs.truth == 101
        assert result.epochs.skipped == 20
        assert result.epochs.scored == 81
        assert result.errors is not None
        first = result.errors.stamp_ns[result.errors.scored][0]
        assert first == stamps(7.0)

    def test_skip_counts_from_the_first_estimate(self) -> None:
        result = evaluate(
            flight(np.arange(4.0, 20.0, 0.01)), flight(TRUTH), scoring=Scoring(skip=2.0)
        )

        assert result.epochs is not None
        assert result.epochs.uncovered == 41  # 40 before, and the very last
        assert result.epochs.skipped == 20

    def test_what_a_low_coverage_comes_from_is_said(self) -> None:
        # GIVEN an estimate that begins 2 s late and has a gap of 5 s
        t = np.concatenate((np.arange(2.0, 10.0, 0.01), np.arange(15.0, 20.0, 0.01)))

        result = evaluate(flight(t), flight(TRUTH))

        [note] = [note for note in result.notes if "covers only" in note]
        assert "2.0 s late" in note
        assert "24.9 % lie in gaps of more than 0.25 s (--max-gap)" in note


class TestWhatIsScored:
    def test_epochs_at_fix_stamps_are_not(self) -> None:
        # GIVEN 5 Hz fixes made from a 10 Hz truth, with stamps rounded a little differently
        fixes = flight(np.arange(0.0, 20.1, 0.2)).stamp_ns + 40

        result = evaluate(flight(FAST), flight(TRUTH), fix_stamp_ns=fixes)

        assert result.epochs is not None
        assert result.epochs.fed == 101
        assert result.epochs.scored == 100
        assert result.epochs.truth == 201

    def test_verdicts_tell_the_fix_stamps_where_fixes_are_not_recorded(self) -> None:
        result = evaluate(flight(FAST), flight(TRUTH), verdicts=verdicts(np.arange(0.0, 20.1, 0.2)))

        assert result.epochs is not None
        assert result.epochs.fed == 101

    def test_a_fix_of_velocity_feeds_no_position(self) -> None:
        at = np.arange(0.0, 20.1, 0.2)

        result = evaluate(
            flight(FAST),
            flight(TRUTH),
            verdicts=verdicts(at, kind=np.full(len(at), "velocity")),
        )

        assert result.epochs is not None
        assert result.epochs.fed == 0

    def test_if_all_were_fed_the_way_out_is_named(self) -> None:
        truth = flight(TRUTH)

        with pytest.raises(InputError, match="--include-fed"):
            evaluate(flight(FAST), truth, fix_stamp_ns=truth.stamp_ns)
        all_the_same = evaluate(
            flight(FAST),
            truth,
            fix_stamp_ns=truth.stamp_ns,
            scoring=Scoring(include_fed=True),
        )
        assert all_the_same.epochs is not None
        assert all_the_same.epochs.scored == len(truth)

    def test_an_estimate_that_stops_early_is_said(self) -> None:
        result = evaluate(flight(np.arange(2.0, 8.005, 0.01)), flight(TRUTH))

        assert result.coverage == pytest.approx(61 / 201)
        assert any("2.0 s late" in note and "12.0 s early" in note for note in result.notes)

    def test_no_interpolation_over_long_gaps(self) -> None:
        hole = np.concatenate((np.arange(0.0, 5.0, 0.01), np.arange(8.0, 20.005, 0.01)))

        result = evaluate(flight(hole), flight(TRUTH))

        assert result.largest_gap == pytest.approx(3.01)
        assert result.epochs is not None
        assert result.epochs.uncovered == 30
        with pytest.raises(InputError, match="--max-gap"):
            evaluate(flight([0.05, 10.05, 19.95]), flight(TRUTH))

    def test_nan_in_the_truth_is_left_out(self) -> None:
        truth = flight(TRUTH)
        position = truth.position_enu.copy()
        position[7] = np.nan

        result = evaluate(flight(FAST), replace(truth, position_enu=position))

        assert result.epochs is not None
        assert result.epochs.invalid == 1
        assert result.prmse == pytest.approx(0.0, abs=1e-9)

    def test_truth_of_positions_only(self) -> None:
        truth = flight(TRUTH)
        bare = Trajectory(truth.stamp_ns, truth.position_enu)

        result = evaluate(with_sigma(flight(FAST), 1.0), bare)

        assert result.prmse == pytest.approx(0.0, abs=1e-9)
        assert result.velocity_rmse is None
        assert result.attitude_rmse is None
        assert result.nees_velocity is None
        assert result.nees_position is not None
        assert re.search(r"velocity RMSE +-$", table(result), re.MULTILINE)

    def test_both_velocity_errors_are_named(self) -> None:
        """GIVEN a heading 90° off WHEN the velocity is right THEN it is not along the body."""
        right = flight(FAST)
        assert right.velocity_enu is not None and right.quat_xyzw is not None
        quarter = np.array([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
        turned = replace(right, quat_xyzw=rotations.quat_multiply(right.quat_xyzw, quarter))
        speed = float(np.sqrt(np.mean(np.sum(right.velocity_enu**2, axis=1))))

        result = evaluate(turned, flight(TRUTH))

        assert result.velocity_rmse == pytest.approx(0.0, abs=1e-6)
        assert result.body_velocity_rmse == pytest.approx(np.sqrt(2.0) * speed, rel=0.01)
        assert f"along the body's axes {result.body_velocity_rmse:.3g} m/s" in table(result)
        assert result.as_dict()["body_velocity_rmse_mps"] == result.body_velocity_rmse

    def test_a_heading_that_was_never_known_is_not_scored(self) -> None:
        """GIVEN a heading with the σ of any WHEN it is by chance the true one THEN it is not."""
        stated = with_sigma(flight(FAST), 0.5)
        assert stated.attitude_cov is not None
        attitude_cov = stated.attitude_cov.copy()
        attitude_cov[:, 2, 2] = 1.84**2

        known = evaluate(stated, flight(TRUTH))
        unknown = evaluate(replace(stated, attitude_cov=attitude_cov), flight(TRUTH))

        assert known.heading_known
        assert known.heading_rmse == pytest.approx(0.0, abs=1e-6)
        assert unknown.heading_rmse is unknown.attitude_rmse is unknown.nees_attitude is None
        assert unknown.tilt_rmse is not None
        assert "heading -   tilt 0" in table(unknown)
        assert any("heading was never known (its σ is 105° at least)" in n for n in unknown.notes)

    def test_a_heading_that_is_searched_for_anew_is_not_scored_meanwhile(self) -> None:
        """GIVEN a heading 90° off for a while WHEN its σ says so THEN the rest is scored."""
        right = with_sigma(flight(FAST), 0.5)
        assert right.attitude_cov is not None and right.quat_xyzw is not None
        meanwhile = slice(len(right) // 3, len(right) // 2)
        quat, attitude_cov = right.quat_xyzw.copy(), right.attitude_cov.copy()
        quarter = np.array([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
        quat[meanwhile] = rotations.quat_multiply(quat[meanwhile], quarter)
        silent = replace(right, quat_xyzw=quat)
        attitude_cov[meanwhile, 2, 2] = 1.84**2

        wrong = evaluate(silent, flight(TRUTH))
        searched = evaluate(replace(silent, attitude_cov=attitude_cov), flight(TRUTH))

        assert wrong.heading_rmse is not None and wrong.heading_rmse > 0.5
        assert searched.heading_rmse == pytest.approx(0.0, abs=0.05)
        assert searched.body_velocity_rmse < 0.2 * wrong.body_velocity_rmse
        assert searched.prmse == wrong.prmse
        assert any("heading was not known at" in note for note in searched.notes)
        assert not any("heading was not known at" in note for note in wrong.notes)

    def test_few_epochs_are_said(self) -> None:
        result = evaluate(flight(FAST), flight(TRUTH), scoring=Scoring(end=0.5))

        assert any("only 6 epochs" in note for note in result.notes)

    @pytest.mark.parametrize(
        ("scoring", "text"),
        [
            (Scoring(skip=100.0), "--skip"),
            (Scoring(start=50.0), "--start"),
            (Scoring(start=10.0, end=5.0), "--end"),
        ],
    )
    def test_an_empty_window_is_refused(self, scoring: Scoring, text: str) -> None:
        with pytest.raises(InputError, match=text):
            evaluate(flight(FAST), flight(TRUTH), scoring=scoring)

    def test_one_message_is_no_estimate(self) -> None:
        with pytest.raises(InputError, match="fewer than two"):
            evaluate(flight([1.0]), flight(TRUTH))

    def test_covariances_that_are_none_are_said(self) -> None:
        estimate = with_sigma(flight(FAST), 1.0)
        assert estimate.position_cov is not None
        cov = estimate.position_cov.copy()
        cov[:1000] = 0.0

        result = evaluate(replace(estimate, position_cov=cov), flight(TRUTH))

        assert result.nees_position is not None
        assert result.nees_position.count < result.epochs.scored  # type: ignore[union-attr]
        assert any("not positive definite" in note for note in result.notes)

    def test_unordered_tracks_are_sorted(self) -> None:
        estimate, truth = flight(FAST), flight(TRUTH)

        result = evaluate(estimate.rows(slice(None, None, -1)), truth.rows(slice(None, None, -1)))

        assert result.prmse == pytest.approx(0.0, abs=1e-9)


class TestMaps:
    def test_truth_of_another_datum_is_moved(self) -> None:
        there = LocalFrame(DATUM).lla(np.array([300.0, -200.0, 30.0]))
        truth = flight(TRUTH).in_map_of(there)

        result = evaluate(flight(FAST), truth)
        naive = evaluate(flight(FAST), replace(truth, datum_lla=None))

        assert result.prmse == pytest.approx(0.0, abs=1e-7)
        assert result.attitude_rmse == pytest.approx(0.0, abs=1e-9)
        assert naive.prmse == pytest.approx(np.sqrt(300.0**2 + 200.0**2 + 30.0**2), rel=0.01)


class TestOutages:
    def test_the_error_at_the_end_is_that_before_the_returning_fix(self) -> None:
        # GIVEN 5 Hz fixes with one hole, an error that grows in it and vanishes at the next fix
        at = np.concatenate((np.arange(0.0, 5.1, 0.2), np.arange(15.0, 20.0, 0.2)))
        estimate = flight(FAST)
        t = (estimate.stamp_ns - START_NS) * 1e-9
        grown = np.where((t > 5.0) & (t < 14.999), (t - 5.0) * 0.3, 0.0)
        estimate = shifted(estimate, np.stack((grown, 0 * grown, 0 * grown), axis=1))
        estimate = replace(estimate, velocity_enu=None)

        result = evaluate(estimate, flight(TRUTH), fix_stamp_ns=stamps(at))

        (outage,) = result.outages
        assert outage.start == pytest.approx(5.0)
        assert outage.duration == pytest.approx(10.0)
        assert outage.end_error == pytest.approx(0.3 * 9.9)  # the last truth epoch in it
        assert outage.end_horizontal_error == pytest.approx(0.3 * 9.9)
        assert result.outage_error(50) == pytest.approx(0.3 * 9.9)
        assert result.largest_outage_error == pytest.approx(0.3 * 9.9)

    def test_the_largest_error_of_an_outage_need_not_be_its_last(self) -> None:
        # GIVEN an error that is largest in the middle of an outage, as after smoothing
        at = np.concatenate((np.arange(0.0, 5.1, 0.2), np.arange(15.0, 20.0, 0.2)))
        t = (flight(FAST).stamp_ns - START_NS) * 1e-9
        bulge = np.where((t > 5.0) & (t < 15.0), 4.0 - 0.16 * (t - 10.0) ** 2, 0.0)
        estimate = shifted(flight(FAST), np.stack((bulge, 0 * bulge, 0 * bulge), axis=1))

        result = evaluate(
            replace(estimate, velocity_enu=None), flight(TRUTH), fix_stamp_ns=stamps(at)
        )

        assert result.largest_outage_error == pytest.approx(4.0)
        assert result.outage_error(50) < 0.5  # type: ignore[operator]
        assert "largest within 4 m" in " ".join(table(result).split())

    def test_refused_fixes_make_an_outage(self) -> None:
        at = np.arange(0.0, 20.1, 0.2)
        accepted = (at < 8.0) | (at > 13.0)

        result = evaluate(
            flight(FAST),
            flight(TRUTH),
            fix_stamp_ns=stamps(at),
            verdicts=verdicts(at, accepted=accepted),
        )

        (outage,) = result.outages
        assert outage.start == pytest.approx(7.8)
        assert outage.duration == pytest.approx(5.4)

    def test_spans(self) -> None:
        fused = stamps([0.0, 1.0, 2.0, 8.0, 9.0])
        end = int(stamps(9.5))

        assert outage_spans(fused, end, 3.0) == [(fused[2], fused[3])]
        assert outage_spans(fused, int(stamps(30.0)), 3.0)[-1] == (fused[4], int(stamps(30.0)))
        assert outage_spans(stamps(np.arange(0.0, 60.0, 5.0)), int(stamps(60.0)), 3.0) == []
        assert outage_spans(np.empty(0, np.int64), end, 3.0) == []

    def test_no_outage_no_figure(self) -> None:
        assert evaluate(flight(FAST), flight(TRUTH)).outage_error(50) is None


class TestResult:
    def test_the_dictionary_is_plain_and_complete(self) -> None:
        at = np.arange(0.0, 20.1, 0.2)
        result = evaluate(with_sigma(flight(FAST), 1.0), flight(TRUTH), verdicts=verdicts(at))

        data = json.loads(json.dumps(result.as_dict(), allow_nan=False))

        documented = Result.as_dict.__doc__ or ""
        assert all(f"{key}" in documented for key in data)
        assert data["prmse_m"] == pytest.approx(0.0, abs=1e-9)
        assert data["nees_position"]["dof"] == 3
        assert data["epochs"]["scored"] == 100
        assert data["outages"] == {
            "count": 0,
            "end_error_median_m": None,
            "end_error_p90_m": None,
            "largest_error_m": None,
            "each": [],
        }

    def test_the_table_fits_a_terminal(self) -> None:
        at = np.concatenate((np.arange(0.0, 5.1, 0.2), np.arange(15.0, 20.0, 0.2)))
        accepted = np.arange(len(at)) % 5 > 0
        reasons = np.where(accepted, "", "innovation gate: farther than the filter believes")
        result = evaluate(
            with_sigma(shifted(flight(FAST[:1500]), [1.0, 2.0, 3.0]), 0.01),
            flight(TRUTH),
            verdicts=verdicts(at, accepted=accepted, reason=reasons),
            scoring=Scoring(skip=1.0),
        )

        shown = table(result)

        assert max(len(line) for line in shown.splitlines()) <= 80
        for text in ("PRMSE", "PMAE", "NEES", "NIS", "overconfident", "outages", "note:", "skip"):
            assert text in shown

    def test_several_runs_are_tabled_with_the_figures_of_one(self) -> None:
        at = np.concatenate((np.arange(0.0, 5.1, 0.2), np.arange(15.0, 20.0, 0.2)))
        result = evaluate(
            with_sigma(shifted(flight(FAST), [0.3, 0.4, 0.0]), 0.5),
            flight(TRUTH),
            verdicts=verdicts(at),
        )

        row = summary(result)

        one = table(result)
        assert row["NEES/dof pos"] == pytest.approx(0.25 / 0.25 / 3)
        assert row["NIS/dof"] == pytest.approx(1.0)
        for value in filter(None, row.values()):
            assert f"{value:.3g}" in one or f"{100 * value:.1f}" in one

    def test_without_truth_only_the_filter_s_own_word(self) -> None:
        result = evaluate(flight(FAST), None, verdicts=verdicts(np.arange(0.0, 20.1, 0.2)))

        assert result.prmse is None
        assert result.nis_position is not None
        assert result.as_dict()["epochs"] is None
        assert "no truth" in table(result)
