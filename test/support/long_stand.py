"""A drive that ends in a long stand, and what has to hold of the clock offset there."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import make_interp_spline
from support.runs import begin

from hybrid_ins.core.update.measurements import Standstill
from hybrid_ins.simulation.motions import START_LLA, Motion
from tools.paper.runs import Scenario, draw


def car_then_stand(duration: float, seed: int) -> Motion:
    """Half a minute of a drive that begins and ends at rest, and standing after it."""
    t = np.arange(0.0, duration + 0.1, 0.1)
    speed = 8.0 * np.sin(np.pi * np.clip(t / 30.0, 0.0, 1.0)) ** 2
    yaw = 0.5 * np.sin(2.0 * np.pi * np.clip(t / 30.0, 0.0, 1.0)) + seed
    velocity_n = speed[:, None] * np.stack((np.cos(yaw), np.sin(yaw), 0.0 * t), axis=1)
    rpy = np.stack((0.0 * t, 0.0 * t, yaw), axis=1)
    displacement = make_interp_spline(t, velocity_n, k=5).antiderivative()
    return Motion(START_LLA, duration, displacement, make_interp_spline(t, rpy, k=5))


def assert_standing_shows_nothing_of_the_clock(seed: int) -> None:
    """
    GIVEN a drive, and a vehicle that then stands for half an hour with zero updates
    THEN the offset stays within three sigma, and sigma grows again.
    """
    rest, stand = 30.0, 1800.0
    scene = Scenario("stop", car_then_stand, rate=20.0, duration=rest + stand, fix_rate=1.0)
    run = draw(scene, seed)
    ins, stamps, at = begin(run), run.samples["t_ns"], 1
    sigma = []
    for k, fix in enumerate(run.fixes):
        stop = int(np.searchsorted(stamps, fix.t_ns, side="right"))
        ins.ring.extend(run.samples[at:stop])
        ins.predict_block(run.samples[at:stop])
        at = stop
        ins.submit(fix)
        if k > rest + 5.0:
            ins.submit(Standstill.of(ins.ring.latest(20)))
        assert abs(ins.clock.residual) < 3.0 * ins.clock.sigma
        sigma.append(ins.clock.sigma)
    assert min(sigma) >= 1e-3
    assert sigma[-1] > 0.9 * np.sqrt(min(sigma) ** 2 + 1e-6 * stand)
