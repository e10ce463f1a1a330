"""Aiding sensors on drives: wheels through an outage, a heading that is wrong, a barometer."""

from dataclasses import replace

import numpy as np
import pytest
from support.outage_drives import calibrated, drive, recording

from hybrid_ins.ros.estimator.estimator import Estimator
from tools.vehicles.aiding import Aiding, barometer, compass, in_order, wheels
from tools.vehicles.drives import Drive
from tools.vehicles.judge import run
from tools.vehicles.outages import begins, ends


def aiding_values(estimator: Estimator, t_ns: int) -> dict[str, str]:
    return dict(next(s for s in estimator.status.diagnostics(t_ns) if "aiding" in s.name).values)


@pytest.mark.slow
def test_wheels_bridge_an_outage_with_their_scale_found() -> None:
    """
    GIVEN wheels that read 1 % too little, and a barometer that is off by 30 m
    WHEN fixes are missing for 60 s
    THEN the error is below 1 % of the distance, and half of that of the constraint alone.
    """
    aiding = in_order(wheels(recording("road car"), 1.01), barometer(recording("road car")))

    aided = ends(drive("road car"), calibrated(), aiding=aiding)
    alone = ends(drive("road car"), calibrated(**{"vehicle.kind": "other"}))

    assert aided[-1].error < 0.01 * aided[-1].distance
    assert aided[-1].error < 0.1 * alone[-1].error
    assert aided[-1].nees < 4.0


@pytest.mark.slow
def test_a_barometer_that_jumps_is_named_and_does_not_bend_the_height_silently() -> None:
    """
    GIVEN a barometer that jumps by 5 m now and then, and claims decimetres
    WHEN fixes are missing for 60 s
    THEN it was named, and the covariance holds.
    """
    aiding, log = barometer(recording("road car")), []
    for one in aiding:
        at = (one.arrival_ns - aiding[0].arrival_ns) * 1e-9
        one.message.fluid_pressure += 60.0 * (int(at / 45.0) % 2)

    found = ends(drive("road car"), calibrated(), lambda _, text: log.append(text), aiding)

    assert any("baro errs by more than it claims" in text for text in log)
    assert max(end.nees for end in found) < 4.0


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_wheels_that_are_stuck_at_a_speed_do_not_take_the_filter_along(noise: float) -> None:
    """
    GIVEN wheels that repeat one speed from 15 s into the first outage on, with or without noise
    THEN they are named, the covariance holds, and the error is that without them, or less.
    """
    found, rng, log = drive("road car"), np.random.default_rng(2), []
    aiding = wheels(recording("road car"), 1.0)
    start = begins(found)[0]
    t = np.array([one.arrival_ns - found.imu_ns[0] for one in aiding]) * 1e-9
    stuck = [one for one, at in zip(aiding, t, strict=True) if at > start + 15.0]
    speed = stuck[0].message.twist.twist.linear.x
    for one in stuck:
        one.message.twist.twist.linear.x = speed + noise * rng.standard_normal()
    other = calibrated(**{"vehicle.kind": "other"})

    aided = ends(found, other, lambda _, text: log.append(text), aiding, np.array([start]))
    alone = ends(found, other, starts=np.array([start]))

    said = "repeats one reading" if noise == 0.0 else "disagrees with the motion"
    assert any(said in text for text in log)
    assert [end.after for end in aided] == [30.0, 60.0]
    for end, unaided in zip(aided, alone, strict=True):
        assert end.error < max(unaided.error, 5.0)
        assert end.nees < 4.0


def horizontal(found: Drive, aiding: list[Aiding], until: float) -> tuple[Estimator, list[str]]:
    """Return the estimator after some seconds, and what it logged."""
    log: list[str] = []
    end_ns = int(found.imu_ns[0]) + round(until * 1e9)
    n = int(np.searchsorted(found.imu_ns, end_ns))
    cut = replace(found, imu_ns=found.imu_ns[:n], force=found.force[:n], rate=found.rate[:n])
    cut = cut.thinned(cut.arrival_ns < end_ns)
    aiding = [one for one in aiding if one.arrival_ns < end_ns]
    return run(cut, calibrated(), lambda _, text: log.append(text), aiding)[0], log


def test_scale_and_offset_are_in_the_diagnostics_and_nothing_counts_as_a_fix() -> None:
    aiding = in_order(wheels(recording("road car"), 1.01), barometer(recording("road car")))

    estimator, log = horizontal(drive("road car"), aiding, 125.0)
    plain, _ = horizontal(drive("road car"), [], 125.0)

    found = aiding_values(estimator, estimator.navigator.last_ns)
    assert (found["velocity"], found["baro"], found["heading"]) == ("aiding", "aiding", "absent")
    assert float(found["velocity_scale"]) == pytest.approx(1.01, abs=0.003)
    assert float(found["baro_offset"]) == pytest.approx(30.0, abs=3.0)
    assert estimator.reporter.fixes_fused == plain.reporter.fixes_fused
    assert any("velocity agrees with the motion" in line for line in log)
    best, other = estimator.navigator.filter, plain.navigator.filter
    assert best is not None
    assert other is not None
    np.testing.assert_array_equal(best.nav, other.nav)  # while fixes come they alone determine it


def test_a_wrong_heading_is_found_within_15_s_of_motion_and_does_no_harm() -> None:
    """
    GIVEN a heading that is wrong by 30° and claims 2°
    WHEN the car has moved for 15 s
    THEN it is refused, and the state is that without it, to the bit.
    """
    wrong = compass(recording("road car"), np.radians(30.0), np.radians(2.0))

    with_it, log = horizontal(drive("road car"), wrong, 10.0 + 2.5 + 15.0)
    without, _ = horizontal(drive("road car"), [], 10.0 + 2.5 + 15.0)

    found = aiding_values(with_it, with_it.navigator.last_ns)
    assert found["heading"] == "refused"
    assert any("heading disagrees with the motion" in line for line in log)
    state, plain = with_it.navigator.filter, without.navigator.filter
    assert state is not None
    assert plain is not None
    np.testing.assert_array_equal(state.nav, plain.nav)


def test_a_right_heading_is_used() -> None:
    right = compass(recording("road car"), 0.0, np.radians(2.0))

    estimator, _ = horizontal(drive("road car"), right, 60.0)

    found = aiding_values(estimator, estimator.navigator.last_ns)
    assert found["heading"] == "aiding"
    assert not any(name.startswith("heading: innovation") for name in estimator.inputs.counts)
