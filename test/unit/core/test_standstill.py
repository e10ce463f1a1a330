"""Standing is told from vibration, hovering and cruising."""

import types
from typing import Any

import numpy as np
import pytest

from hybrid_ins.core.imu_monitor import ImuMonitor
from hybrid_ins.core.samples import SAMPLE_DTYPE, ImuRing
from hybrid_ins.core.standstill import is_standing, is_standing_with_engine
from hybrid_ins.core.state import COVARIANCE, DIAGONAL, DV, N_NAV, VELOCITY

RATE = 200.0
ENGINE = {  # idling: 27 Hz and its second harmonic
    "force": lambda t: 1.5 * np.sin(2.0 * np.pi * 27.0 * t) + 0.6 * np.sin(2.0 * np.pi * 54.0 * t),
    "rate": lambda t: 0.04 * np.sin(2.0 * np.pi * 27.0 * t),
    "force_std": 0.1,
    "rate_std": 0.004,
}


def samples(force_std=0.02, rate_std=0.002, seconds=1.0, force=None, rate=None, seed=0):
    rng = np.random.default_rng(seed)
    n = int(seconds * RATE)
    table = np.zeros(n, SAMPLE_DTYPE)
    t = np.arange(n) / RATE
    table["t_ns"] = np.rint(t * 1e9) + 1
    table["f"] = [0.0, 0.0, -9.8] + force_std * rng.standard_normal((n, 3))
    table["w"] = rate_std * rng.standard_normal((n, 3))
    if force is not None:
        table["f"] += force(t)[:, None]
    if rate is not None:
        table["w"] += rate(t)[:, None]
    return table


def test_a_calm_sensor_stands() -> None:
    assert is_standing(samples())


def test_a_biased_sensor_that_stands_stands() -> None:
    assert is_standing(samples(rate=lambda t: 0.01 + 0.0 * t))


@pytest.mark.parametrize(
    ("what", "changes"),
    [
        ("vibration", {"force_std": 0.5}),
        ("a vibrating gyroscope", {"rate_std": 0.05}),
        ("a hovering drone that balances", {"rate": lambda t: 0.015 * np.sin(2 * np.pi * 1.5 * t)}),
        ("speeding up", {"force": lambda t: 0.5 * t}),
        ("a slow turn", {"rate": lambda t: 0.1 + 0.0 * t}),
        ("swaying", {"force": lambda t: 0.2 * np.sin(2 * np.pi * t)}),
    ],
)
def test_motion_is_not_standing(what: str, changes: dict) -> None:
    assert not is_standing(samples(**changes)), what


def test_too_few_samples_tell_nothing() -> None:
    assert not is_standing(samples(seconds=0.05))


def test_an_engine_that_idles_hides_standing_from_the_samples_but_not_from_the_spectrum() -> None:
    for seed in range(20):
        window = samples(**ENGINE, seed=seed)
        assert not is_standing(window)
        assert is_standing_with_engine(window)


@pytest.mark.parametrize(
    ("what", "force", "rate"),
    [
        ("speeding up", lambda t: 0.5 * t, None),
        ("swaying", lambda t: 0.2 * np.sin(2.0 * np.pi * t), None),
        ("a hovering drone that balances", None, lambda t: 0.015 * np.sin(3.0 * np.pi * t)),
        ("a slow turn", None, lambda t: 0.1 + 0.0 * t),
    ],
)
def test_motion_under_vibration_is_not_standing(what: str, force: Any, rate: Any) -> None:
    nothing = np.zeros_like
    shaken = {
        **ENGINE,
        "force": lambda t: ENGINE["force"](t) + (force or nothing)(t),
        "rate": lambda t: ENGINE["rate"](t) + (rate or nothing)(t),
    }
    assert not is_standing_with_engine(samples(**shaken)), what


def test_too_few_samples_tell_nothing_of_an_engine() -> None:
    assert not is_standing_with_engine(samples(**ENGINE, seconds=0.05))


@pytest.mark.parametrize(
    ("what", "speed", "speed_std", "fixes_move", "stands"),
    [
        ("a car with its engine on", 0.05, 0.1, False, True),
        ("the same after 10 s without fixes", 0.5, 0.5, False, True),
        ("a plane in steady flight", 15.0, 0.3, False, False),
        ("a plane after a minute without fixes", 2.0, 3.0, False, False),
        ("a ferry", 6.0, 0.2, False, False),
        ("a ferry of which only the fixes show motion", 0.3, 0.3, True, False),
    ],
)
def test_an_engine_is_on_in_what_stands_and_in_what_cruises(
    what: str, speed: float, speed_std: float, fixes_move: bool, stands: bool
) -> None:
    """The vibration is the same: what the filter knows of its speed distinguishes them."""
    nav = np.zeros(N_NAV)
    nav[VELOCITY] = [speed, 0.0, 0.0]
    nav[COVARIANCE][DIAGONAL[DV]] = speed_std**2
    monitor, ring, fused = ImuMonitor(zero_updates=True), ImuRing(), []
    filters: Any = types.SimpleNamespace(
        phase=types.SimpleNamespace(best=types.SimpleNamespace(nav=nav)),
        filter=None,
        measure=fused.append,
        submit=fused.append,
    )
    whole = samples(**ENGINE, seconds=15.0)
    for k in range(int(RATE), len(whole), int(0.5 * RATE)):
        ring.extend(whole[k - int(RATE) if k == int(RATE) else k - int(0.5 * RATE) : k])
        monitor.check(filters, ring, int(whole["t_ns"][k - 1]), fixes_move)
        assert stands or not monitor.may_stand, what

    assert monitor.standing == stands, what
    assert bool(fused) == stands, what
