"""The smoother against dense references: Rauch-Tung-Striebel, and batch least squares."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from hybrid_ins.core.aiding.measurements import BarometricHeight, BodyVelocity, Heading
from hybrid_ins.core.constraints.nonholonomic import NonHolonomic, Nose
from hybrid_ins.core.filter.events import CovarianceInflation
from hybrid_ins.core.filter.filter_noise import FilterNoise
from hybrid_ins.core.filter.filter_record import FilterRecord
from hybrid_ins.core.filter.filter_settings import FilterSettings
from hybrid_ins.core.filter.ins_filter import InsFilter
from hybrid_ins.core.filter.measurement_update import Outcome
from hybrid_ins.core.imu.samples import SAMPLE_DTYPE, ImuRing
from hybrid_ins.core.inertial.earth import curvature_scale
from hybrid_ins.core.inertial.rotations import matrix_from_quat, rpy_from_quat
from hybrid_ins.core.inertial.state import (
    DP,
    DV,
    EPS,
    N_ERROR,
    N_FLAT,
    N_NAV,
    PAST_VARIANCE,
    PLACES,
    PSD,
    QUAT,
    covariance,
)
from hybrid_ins.core.noise.position_scatter import Split
from hybrid_ins.core.noise.process_noise import ConstantNoise, ProcessNoise
from hybrid_ins.core.noise.slow_error import LASTING
from hybrid_ins.core.noise.weights import NoiseFactors
from hybrid_ins.core.sensor_errors.clock_offset import ClockOffsetObserver
from hybrid_ins.core.sensor_errors.clock_prior import ClockDrift, ClockPrior
from hybrid_ins.core.smoothing import hindsight
from hybrid_ins.core.smoothing.constant_errors import ConstantErrors
from hybrid_ins.core.smoothing.segments import Update
from hybrid_ins.core.smoothing.smoother import N_ADJOINT, N_PACKED, N_STATE, Smoother
from hybrid_ins.core.update.gate import Gate
from hybrid_ins.core.update.inflation import inflate
from hybrid_ins.core.update.iterated_update import update as correct
from hybrid_ins.core.update.kalman import heading_turn, update_in_body
from hybrid_ins.core.update.measurements import GNSS, Measurement, PositionFix
from hybrid_ins.row_file import BlockFile, RowFile
from tools.field.batch_least_squares import (
    LONG_STEP_NS,
    PERIOD_NS,
    PSD_TRUE,
    RATE,
    STD,
    T0_NS,
    Flight,
    advance,
    batch_least_squares,
    difference,
    gather,
    make,
    mean_square,
    reading,
    started,
)

Array = NDArray[np.float64]


def aided(flight: Flight) -> list[Measurement]:
    """Return the flight's fixes and, between them, what other sensors measure."""
    rng, measured = np.random.default_rng(7), list[Measurement](flight.fixes)
    nose = Nose(0.0, 0.0, np.array([-0.5, 0.0, 0.2]))
    for k in range(30, len(flight.true) - 1, 40):
        state, sample = flight.true[k], flight.samples[k]
        t_ns, velocity_b = (
            int(sample["t_ns"]),
            matrix_from_quat(state.quat_xyzw).T @ state.velocity_n,
        )
        yaw = float(rpy_from_quat(state.quat_xyzw)[2])
        wide = np.diag((0.04, 0.04, 0.04))
        made: list[Measurement] = [
            BodyVelocity(t_ns, velocity_b + 0.2 * rng.standard_normal(3), wide, np.zeros(3)),
            Heading(t_ns, yaw + 0.05 * float(rng.standard_normal()), 0.05**2),
            BarometricHeight(t_ns, float(state.lla[2] + 0.5 * rng.standard_normal()), 0.25),
            NonHolonomic(t_ns, sample["w"].copy(), nose, np.diag((25.0, 25.0))),
        ]
        measured.append(made[k // 40 % len(made)])
    return sorted(measured, key=lambda measurement: measurement.t_ns)


@pytest.mark.parametrize("aids", [False, True])
def test_smoothed_errors_are_those_of_rauch_tung_and_striebel(aids: bool) -> None:
    # GIVEN the linear problem that a filter's run leaves: transition matrices and covariances
    flight = Flight(1, std=STD * 0.05)
    measured = aided(flight) if aids else flight.fixes
    updates = [Update(f.t_ns, PSD_TRUE * (1.0 + k % 3), f) for k, f in enumerate(measured)]
    inflated = np.repeat((0.0, 0.4, 0.0, 0.0, 0.0), 3)
    early_ns, lever_b = updates[20].t_ns - 50_000_000, np.array([0.5, -1.0, -2.0])
    inflation = CovarianceInflation(early_ns, inflated, lever_b)
    updates.insert(20, Update(early_ns, PSD_TRUE, inflation=inflation))
    smoother, _, adjoints = make(flight, updates)
    smoother.run()
    nav, last_ns, begin = started(flight.start), T0_NS, 1
    P_after, P_before, phis, moved, turns = [covariance(nav)], [], [], [], []
    for update in updates:
        stop = int(np.searchsorted(flight.samples["t_ns"], update.t_ns, side="right"))
        phis.append(advance(nav, flight.samples[begin:stop], last_ns))
        P_before.append(covariance(nav))
        if update.measurement is None:
            inflate(nav, inflated, lever_b)
            moved.append(np.zeros(N_ERROR))
            turns.append(np.eye(N_ERROR))
        else:
            model = update.measurement.linearise(nav)
            if update.measurement.in_body:
                dx, _, T = update_in_body(nav, *model)
            else:
                dx, _, turn = correct(nav, *model)
                T = heading_turn(turn)
            moved.append(dx)
            turns.append(T)
        P_after.append(covariance(nav))
        nav[PSD] = update.psd
        begin, last_ns = stop, update.t_ns
    # WHEN it is smoothed by the textbook, backwards from the last update
    P_s, e = P_after[-1], np.zeros(N_ERROR)
    for k in range(len(updates) - 1, -1, -1):
        if updates[k].measurement is None:  # process noise at an instant: a step of its own
            C = np.linalg.solve(P_after[k + 1], P_before[k]).T
            e, P_s = C @ e, P_before[k] + C @ (P_s - P_after[k + 1]) @ C.T
        else:
            back = np.linalg.inv(turns[k])
            e, P_s = back @ e + moved[k], back @ P_s @ back.T
        # THEN the adjoint before each update says the same, error and covariance
        costate, information = adjoints[k][:N_ERROR], adjoints[k][N_ERROR:][:N_PACKED][PLACES]
        std = np.sqrt(np.diag(P_before[k]))
        assert np.abs((P_before[k] @ costate - e) / std).max() < 1e-9
        own = P_before[k] - P_before[k] @ information @ P_before[k]
        assert np.abs((own - P_s) / np.outer(std, std)).max() < 1e-9
        C = np.linalg.solve(P_before[k], phis[k] @ P_after[k]).T
        e, P_s = C @ e, P_after[k] + C @ (P_s - P_before[k]) @ C.T


def test_smoothed_flights_are_those_of_batch_least_squares() -> None:
    squares = []
    for seed in (2, 3, 4, 5):
        # GIVEN a flight that begins with errors as large as its covariance says
        flight = Flight(seed)
        smoother, _, _ = make(flight, [Update(f.t_ns, PSD_TRUE, f) for f in flight.fixes])
        # WHEN it is smoothed, and solved at once
        t_ns, rows = gather(smoother)
        navs, P = batch_least_squares(flight, flight.fixes)
        # THEN the states agree, measured by what is uncertain of them, and so do the deviations
        at = np.searchsorted(t_ns, [T0_NS, *(f.t_ns for f in flight.fixes)])
        sigma = np.sqrt(np.diag(P)).reshape(-1, N_ERROR)
        apart = np.array([difference(rows[k], nav) for k, nav in zip(at, navs, strict=True)])
        assert np.sqrt(np.mean((apart / sigma) ** 2)) < 0.15
        own = np.array([np.sqrt(np.diag(covariance(rows[k]))) for k in at])
        assert np.abs(own / sigma - 1.0).max() < 0.1
        truth = [flight.true[int(k)].to_flat() for k in np.rint((t_ns[at] - T0_NS) / PERIOD_NS)]
        squares.append([mean_square(truth, rows[at]), mean_square(truth, navs)])
    # AND the smoothed errors are as small
    by_smoother, by_batch = np.sqrt(np.mean(squares, axis=0))
    assert by_smoother < 1.01 * by_batch


def test_start_about_a_smoothed_heading_keeps_a_positive_covariance() -> None:
    """With the heading's variance replaced beside its covariances it was indefinite."""
    flight = Flight(1)
    P = np.diag(STD**2)
    P[8, 8], P[8, 3], P[3, 8] = 1.0, 0.8 * STD[3], 0.8 * STD[3]
    start = replace(flight.start, state=replace(flight.start.state, P=P))
    found = replace(start.state, P=1e-6 * np.eye(N_ERROR))

    moved = hindsight._about_heading(start, found).state

    assert moved.P[8, 8] == pytest.approx(hindsight.LEAST_HEADING_STD**2)
    assert np.linalg.eigvalsh(moved.P / np.outer(STD, STD)).min() > 0.0
    assert moved.P[3, 8] / np.sqrt(moved.P[8, 8]) == pytest.approx(P[3, 8])


def test_a_record_keeps_the_drift_of_the_clock_and_what_motion_does_not_show() -> None:
    nothing: Any = SimpleNamespace(
        measurement=None, levels=lambda: np.ones(6), found=NoiseFactors()
    )
    record, clock = FilterRecord(nothing), ClockOffsetObserver(0.1, drift=ClockDrift(3e-4))
    update: Any = SimpleNamespace(
        noise=nothing,
        clock=clock,
        scale_errors=SimpleNamespace(considered=np.ones(6)),
        heading=SimpleNamespace(considered=lambda nav: 0.01),
    )

    nav = np.zeros(N_FLAT)
    nav[PAST_VARIANCE] = 4.0
    record.add(nothing, Outcome(None, 1.0, False, None), update, nav)
    record.add_too_old(nothing, update, nav)

    nav[PAST_VARIANCE] = 0.0  # it is the filter's, which goes on
    for decided in (record.decided[0], record.too_old[0]):
        assert decided.past_variance.tolist() == [4.0, 4.0, 4.0]
        assert decided.clock_drift == 3e-4
        assert decided.clock_variance == pytest.approx(clock.sigma**2)
        assert decided.heading_by_noise == 0.01


def test_in_an_outage_the_attitude_is_as_uncertain_by_scale_errors_as_before() -> None:
    # GIVEN a filter without any event, and one whose P contains them in the third of four
    def kept(*considered: float) -> Any:
        decided = [
            SimpleNamespace(
                event=SimpleNamespace(t_ns=k),
                levels=np.ones(6),
                r_scale=1.0,
                attitude_by_scale=np.full(6, square),
                heading_by_noise=square,
            )
            for k, square in enumerate(considered, start=1)
        ]
        record = SimpleNamespace(start=SimpleNamespace(t_ns=0), decided=decided, too_old=[])
        return SimpleNamespace(filters=[(SimpleNamespace(record=record), 0.0)])

    # THEN nothing is said of that time, and nothing at all of the other filter
    stamps, squares = hindsight.Hindsight(kept(1.0, 2.0, 0.0, 4.0)).attitude_by_scale()
    assert stamps.tolist() == [1, 2, 4]
    assert squares[:, 5].tolist() == [1.0, 2.0, 4.0]
    stamps, squares = hindsight.Hindsight(kept()).attitude_by_scale()
    assert stamps.tolist() == [0]
    assert not squares.any()
    # AND what motion does not show of the heading is that of all times
    stamps, variances = hindsight.Hindsight(kept(1.0, 2.0, 0.0, 4.0)).heading_by_noise()
    assert (stamps.tolist(), variances.tolist()) == ([1, 2, 3, 4], [1.0, 2.0, 0.0, 4.0])
    stamps, variances = hindsight.Hindsight(kept()).heading_by_noise()
    assert (stamps.tolist(), variances.tolist()) == ([0], [0.0])


def test_what_positions_show_of_their_errors_is_said_of_the_time_before_too() -> None:
    # GIVEN a filter that saw a jump in the third of four steps, and has half forgotten it
    second = 1_000_000_000
    decided = [
        SimpleNamespace(
            event=SimpleNamespace(t_ns=round(10 * k * second)),
            levels=np.ones(6),
            r_scale=1.0,
            past_variance=np.array([variance, variance, 0.0]),
        )
        for k, variance in enumerate((0.0, 0.0, 9.0, 4.5), start=1)
    ]
    record = SimpleNamespace(start=SimpleNamespace(t_ns=0), decided=decided, too_old=[])
    stretch: Any = SimpleNamespace(filters=[(SimpleNamespace(record=record), 0.0)])

    stamps, variances = hindsight.Hindsight(stretch).past_positions()

    left = np.exp(-20.0 / LASTING)  # of the variance, after 10 s
    assert stamps.tolist() == [10 * second, 20 * second, 30 * second, 40 * second]
    np.testing.assert_allclose(variances[:, 0], [9.0 * left**2, 9.0 * left, 9.0, 4.5])
    assert not variances[:, 2].any()


@pytest.mark.parametrize("drift", [0.0, 3e-4])
def test_the_offset_of_a_clock_that_drifts_is_smoothed_along_its_drift(drift: float) -> None:
    """
    GIVEN a filter that has found a drift, and offsets within its σ of 5 ms
    THEN the smoothed ones lie on that line: as a walk, they were 7 ms late.
    """
    rng, gnss = np.random.default_rng(4), SimpleNamespace(measurement=SimpleNamespace(sensor=GNSS))
    true = 0.02 + drift * np.arange(200.0)
    residuals = true + np.append(0.005 * rng.standard_normal(199), 0.0)  # the last one is best
    steps: list[Any] = [
        SimpleNamespace(
            decided=SimpleNamespace(
                verdict=gnss,
                event=SimpleNamespace(t_ns=k * 1_000_000_000),
                clock_residual=residual,
                clock_variance=0.005**2,
                clock_drift=drift,
            ),
            applied=0.0,
        )
        for k, residual in enumerate(residuals.tolist())
    ]

    moved = hindsight._clock(steps)

    assert abs(np.mean(moved[:150] - true[:150])) < 0.001
    assert np.std(moved[:150] - true[:150]) < 0.0005


def test_gaps_and_interpolated_stamps_are_those_of_the_filter() -> None:
    # GIVEN samples with a gap, a fix inside it, and fixes between two samples
    flight = Flight(5)
    kept = np.ones(len(flight.samples), bool)
    kept[505:530] = False
    samples = flight.samples[kept]
    fused = [replace(f, t_ns=f.t_ns + 3_000_000) for f in flight.fixes]
    # WHEN they are filtered, and smoothed with the weights that they had there
    ring = ImuRing()
    process = ProcessNoise(PSD_TRUE[6:], 1.0 / RATE)
    noise = FilterNoise(ConstantNoise(process.q(PSD_TRUE[:6])), process)
    gate = Gate(dict.fromkeys((1, 2, 3, 6), np.inf), 3.0)
    running = InsFilter(
        flight.start.state, T0_NS, flight.start.sample, noise, gate, ring, FilterSettings()
    )
    for fix in fused:
        running.submit(fix)
    running.predict_block(samples[1:])
    weights = {v.measurement.t_ns: v.weight for v in running.verdicts}
    updates = [Update(f.t_ns, PSD_TRUE, f, 1.0 / weights[f.t_ns]) for f in fused]
    t_ns, rows = gather(make(flight, updates, samples)[0])
    # THEN there is a state for each sample, and the last one, which nothing follows, is the same
    assert np.array_equal(t_ns, samples["t_ns"])
    assert np.abs(difference(rows[-1], running.state.to_flat())).max() < 1e-9
    P, P_filter = covariance(rows[-1]), running.state.P
    assert np.abs(P - P_filter).max() < 1e-9 * np.abs(P_filter).max()
    # AND the gap, in which nothing was measured, costs certainty
    whole_ns, whole = gather(make(flight, [Update(f.t_ns, PSD_TRUE, f) for f in fused])[0])
    behind = samples["t_ns"][505]
    traces = [
        np.trace(covariance(states[np.searchsorted(stamps, behind)])[DV, DV])
        for states, stamps in ((rows, t_ns), (whole, whole_ns))
    ]
    assert traces[0] > 1.5 * traces[1]


def test_a_position_that_is_not_fused_leaves_its_slow_error_out() -> None:
    # GIVEN a position far off, with a slow error that changes, and a threshold that excludes it
    flight = Flight(1)
    updates = [Update(fix.t_ns, PSD_TRUE, fix) for fix in flight.fixes]
    fix = updates[9].measurement
    assert isinstance(fix, PositionFix)
    far = replace(fix, lla=fix.lla + np.array([0.0, 0.0, 500.0]))
    split = Split(np.eye(3), np.ones(3), 1.0, claimed_growth=np.full(3, 0.1))
    excluded = Update(far.t_ns, PSD_TRUE, far, threshold=20.0, split=split)
    # WHEN it is smoothed with it and without
    after = []
    for tenth in (excluded, Update(far.t_ns, PSD_TRUE)):
        smoother, states, _ = make(flight, [*updates[:9], tenth, *updates[10:]])
        smoother.run()
        after.append(states[10][:N_NAV])
    # THEN the forward state is the same
    np.testing.assert_array_equal(*after)


def test_state_is_carried_back_before_the_start() -> None:
    # GIVEN a filter that starts in the flight
    flight = Flight(6)
    at = 300
    late = replace(
        flight.start,
        t_ns=int(flight.samples["t_ns"][at]),
        sample=reading(flight.samples[at]),
        state=replace(flight.true[at], P=np.diag(STD**2)),
    )
    updates = [Update(f.t_ns, PSD_TRUE, f) for f in flight.fixes if f.t_ns > late.t_ns]
    smoother = Smoother(late, flight.samples, updates, 0.01 - 1e-6, LONG_STEP_NS, {}, {})
    # WHEN it is smoothed
    t_ns, rows = gather(smoother)
    # THEN there is a state for each sample, and its error is as large as it says
    assert np.array_equal(t_ns, flight.samples["t_ns"])
    for k in (0, 100, 200, 300):
        e = difference(flight.true[k].to_flat(), rows[k])
        for block in (DP, DV, EPS):
            P = covariance(rows[k])[block, block]
            assert e[block] @ np.linalg.solve(P, e[block]) < 16.3  # chi-square, 3, 99.9 %
    std = [np.sqrt(np.trace(covariance(rows[k])[DP, DP])) for k in (0, 100, 200, 300)]
    assert std == sorted(std, reverse=True)


@pytest.mark.parametrize("clock", [0.0, 0.05])
def test_a_lever_arm_that_is_not_given_is_found_beside_the_clock(clock: float) -> None:
    errors = []
    for seed in (2, 3):
        # GIVEN a flight whose antenna is away from the IMU, which nobody said, and stamps of fixes
        # that are too early
        flight = Flight(seed)
        lever_b = np.array([0.3, -0.2, -0.4])
        scale = curvature_scale(flight.true[0].lla)
        fused = []
        for fix in flight.fixes:
            state = flight.true[round((fix.t_ns - T0_NS) / PERIOD_NS)]
            lla = fix.lla + matrix_from_quat(state.quat_xyzw) @ lever_b / scale
            fused.append(replace(fix, lla=lla, t_ns=fix.t_ns - round(clock * 1e9)))
        updates = [Update(f.t_ns, PSD_TRUE, f) for f in fused if f.t_ns > T0_NS]
        found = ConstantErrors(None, clock=ClockPrior(0.0, 0.1))
        # WHEN it is smoothed, in passes until neither moves any more
        smoother = Smoother(
            flight.start,
            flight.samples,
            updates,
            0.01 - 1e-6,
            LONG_STEP_NS,
            {},
            {},
            constants=found,
        )
        t_ns, rows = gather(smoother)
        # THEN both are found, as well as their covariance says
        e = found.values - [*lever_b, clock]
        assert e @ np.linalg.solve(found.covariance, e) < 18.5  # chi-square, 4, 99.9 %
        assert np.sqrt(found.covariance[:3, :3].diagonal().min()) < 0.25  # m, of 0.5 before
        assert np.sqrt(found.covariance[3, 3]) < 0.03  # s, of 0.1 before
        for k, nav in zip(range(0, len(t_ns), 50), rows[::50], strict=True):
            # of the antenna's position
            e = difference(flight.true[k].to_flat(), nav)[DP]
            e = e + matrix_from_quat(flight.true[k].quat_xyzw) @ lever_b
            e = e - matrix_from_quat(nav[QUAT]) @ found.lever_b
            errors.append(e @ np.linalg.solve(covariance(nav)[DP, DP], e) / 3.0)
    # AND so are the smoothed positions, whose errors it would dominate
    assert 0.3 < np.mean(errors) < 2.0


def test_what_a_clock_does_to_smoothed_states_is_what_is_considered() -> None:
    # GIVEN a flight that is smoothed with a clock offset to be found
    flight = Flight(2)
    updates = [Update(f.t_ns, PSD_TRUE, f) for f in flight.fixes]
    found = ConstantErrors(np.zeros(3), clock=ClockPrior(0.0, 0.1))
    common = flight.start, flight.samples
    rest = 0.01 - 1e-6, LONG_STEP_NS, {}, {}
    smoother = Smoother(*common, updates, *rest, constants=found)
    rows = gather(smoother)[1]

    def with_offset(offset: float) -> Array:
        moved = []
        for update in updates:
            t_ns = update.t_ns + round((found.clock_offset + offset) * 1e9)
            assert update.measurement is not None
            fix: Any = replace(update.measurement, t_ns=t_ns)  # type: ignore[type-var]
            moved.append(replace(update, t_ns=t_ns, measurement=fix))
        return gather(Smoother(*common, moved, *rest))[1]

    # WHEN the fixes are valid a little later or earlier
    before, there, after = (with_offset(offset) for offset in (-0.004, 0.0, 0.004))
    # THEN the states change by what the covariance of the first run contains
    for k in range(0, len(rows), 40):
        change = difference(after[k], before[k]) / 0.008
        added = covariance(rows[k]) - covariance(there[k])
        expected = found.covariance[3, 3] * np.outer(change, change)
        for block in (DP, DV):
            std = np.sqrt(np.trace(expected[block, block]))
            assert np.sqrt(np.trace(added[block, block])) == pytest.approx(std, rel=0.2)


def smoothing_memory(duration: float) -> int:
    """Return the most bytes that smoothing a recording of so many seconds takes at a time."""
    t_ns = T0_NS + np.arange(round(duration * 50.0), dtype=np.int64) * 20_000_000
    samples = np.zeros(len(t_ns), SAMPLE_DTYPE)
    samples["t_ns"], samples["f"] = t_ns, (0.0, 0.0, -9.81)
    kept = BlockFile()
    kept.append(samples)
    start = Flight(1, duration=3.0).start
    fixes = [
        PositionFix(T0_NS + k * 10_000_000_000, start.state.lla, np.eye(3), np.zeros(3))
        for k in range(1, round(duration / 10.0))
    ]
    updates = [Update(f.t_ns, PSD_TRUE, f) for f in fixes]
    del samples, t_ns, fixes
    tracemalloc.start()
    stores = RowFile(N_STATE), RowFile(N_ADJOINT)
    smoother = Smoother(start, kept.array(), updates, 0.02, LONG_STEP_NS, *stores)
    smoother.run()
    count = sum(len(stamps) for stamps, _ in smoother.states())
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert count > 0.99 * duration * 50.0
    return most


def test_memory_does_not_grow_with_the_recording() -> None:
    smoothing_memory(40.0)  # what is loaded and compiled once does not count
    short, long = smoothing_memory(150.0), smoothing_memory(400.0)
    assert long - short < 150_000  # bytes: 12 500 samples of 56 bytes are 700 000
