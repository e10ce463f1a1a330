"""The drift of the receiver's clock: found over passes, and not where there is none."""

from __future__ import annotations

import numpy as np
import pytest
from support.scenes import scene

from hybrid_ins import parameters
from hybrid_ins.calibration.drift import Drift, remove_drift
from hybrid_ins.calibration.filter_pass import Nominal
from hybrid_ins.calibration.innovations import POSITION
from hybrid_ins.calibration.likelihood import Likelihood
from hybrid_ins.calibration.recording import Recording
from hybrid_ins.ros.messages.conversions import first_biases
from hybrid_ins.simulation import motions

DURATION, RATE = 60.0, 50.0


def found(drift: float, seed: int) -> tuple[Drift, Likelihood, int]:
    """Return the drift of a flight whose fixes are stamped by a drifting clock, other things known.

    The number is how often the other parameters were fitted again.
    """
    times = np.arange(0.37, DURATION - 1.0, 0.2)
    motion = motions.quadrotor_flight(DURATION, seed=seed)
    seen = scene(motion, rate=RATE, seed=seed, fix_times=times)
    recording = Recording(
        "flight",
        seen.t,
        np.hstack((seen.force, seen.rate)),
        seen.fix_t - drift * (seen.fix_t - seen.fix_t.mean()),
        np.full(len(times), POSITION),
        seen.fix_lla,
        np.tile(seen.covariance, (len(times), 1, 1)),
    )
    noise = 4e-4 / RATE, 4e-6 / RATE
    biases = first_biases(parameters.defaults())
    nominal = Nominal(0.0, np.zeros(3), *noise, 1e-3, 1e-5, *biases)
    likelihood = Likelihood([recording.with_measurements_between(1.0, 58.0)], nominal, False)
    likelihood.frozen = frozenset(likelihood.names) - {"offset"}
    likelihood.yaws = [seen.yaw(1.0)]
    passes = []

    def refit(x: np.ndarray) -> tuple[np.ndarray, bool]:
        passes.append(x)
        return x, True

    _, _, drift_found = remove_drift(
        likelihood, np.array([p.mean for p in likelihood.prior]), refit
    )
    return drift_found, likelihood, len(passes)


@pytest.mark.parametrize("drift", [-1e-3, 2e-3])
def test_a_drift_is_found_and_removed(drift: float) -> None:
    result, likelihood, passes = found(drift, 4)
    # THEN it is found to its deviation, over passes until nothing moves
    assert abs(result.value - drift) < 4.0 * result.std
    assert result.std < 0.15 * abs(drift)
    assert 1 < passes < 8
    # AND the recording is on a clock without what was found
    between = np.diff(likelihood.recordings[0].aid_t).mean()
    assert between == pytest.approx(0.2 * (1.0 + result.value - drift), rel=1e-5)


@pytest.mark.parametrize("seed", [2, 4, 6])
def test_a_clock_without_drift_stays_as_it_is(seed: int) -> None:
    result, _, passes = found(0.0, seed)
    assert result.value == 0.0
    assert passes == 0
    assert 0.0 < result.std < 2e-4


@pytest.mark.parametrize("share", [0.3, 0.7, 1.0])
def test_steps_that_are_too_short_lead_there_too(
    share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    # GIVEN steps that are a share of the way to a drift of 1220 ppm
    _, likelihood, _ = found(0.0, 4)
    true, std = 1220e-6, 100e-6

    def step(_: Likelihood, __: np.ndarray, ___: float, at: float) -> Drift:
        return Drift(share * (true - at), std)

    monkeypatch.setattr("hybrid_ins.calibration.drift._newton_step", step)
    # WHEN the drift is looked for, THEN it is found to a share of its deviation
    x = np.array([p.mean for p in likelihood.prior])
    _, converged, result = remove_drift(likelihood, x, lambda x: (x, True))
    assert converged
    assert result.value == pytest.approx(true, abs=0.1 * std / share)
