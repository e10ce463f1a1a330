"""The smoother against dense references: Rauch-Tung-Striebel, and batch least squares."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.filter_noise import FilterNoise
from hybrid_ins.core.gate import Gate
from hybrid_ins.core.inflation import inflate_covariance
from hybrid_ins.core.ins_filter import FilterSettings, InsFilter
from hybrid_ins.core.iterated_update import update as correct
from hybrid_ins.core.noise import ConstantNoise, ProcessNoise
from hybrid_ins.core.samples import ImuRing
from hybrid_ins.core.smoother import Smoother, Update
from hybrid_ins.core.state import (
    COVARIANCE,
    DP,
    DV,
    EPS,
    N_ERROR,
    PLACES,
    PSD,
    covariance,
    pack,
)
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


def test_smoothed_errors_are_those_of_rauch_tung_and_striebel() -> None:
    # GIVEN the linear problem that a filter's run leaves: transition matrices and covariances
    flight = Flight(1, std=STD * 0.05)
    updates = [Update(f.t_ns, PSD_TRUE * (1.0 + k % 3), f) for k, f in enumerate(flight.fixes)]
    inflated = np.repeat((0.0, 0.4, 0.0, 0.0, 0.0), 3)
    updates.insert(20, Update(updates[20].t_ns - 50_000_000, PSD_TRUE, std=inflated))
    smoother, _, adjoints = make(flight, updates)
    smoother.run()
    nav, last_ns, begin = started(flight.start), T0_NS, 1
    P_after, P_before, phis, moved = [covariance(nav)], [], [], []
    for update in updates:
        stop = int(np.searchsorted(flight.samples["t_ns"], update.t_ns, side="right"))
        phis.append(advance(nav, flight.samples[begin:stop], last_ns))
        P_before.append(covariance(nav))
        if update.measurement is None:
            pack(inflate_covariance(covariance(nav), inflated), nav[COVARIANCE])
            moved.append(np.zeros(N_ERROR))
        else:
            moved.append(correct(nav, *update.measurement.linearise(nav))[0])
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
            e = e + moved[k]
        # THEN the adjoint before each update says the same, error and covariance
        costate, information = adjoints[k][:N_ERROR], adjoints[k][N_ERROR:][PLACES]
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
