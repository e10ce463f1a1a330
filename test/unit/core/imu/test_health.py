"""What an IMU's readings show to be wrong with it, and what they do not."""

from pathlib import Path

import numpy as np
import pytest

from hybrid_ins.core.imu.health import FaultKind, find_fault
from hybrid_ins.core.imu.samples import SAMPLE_DTYPE
from hybrid_ins.ros.messages.conversions import mount_matrix
from hybrid_ins.ros.reporting.wording import describe_fault, name_of_fault

RATE = 200.0


def window(force_std=0.5, rate_std=0.05):
    rng = np.random.default_rng(0)
    n = int(RATE)
    samples = np.zeros(n, SAMPLE_DTYPE)
    samples["t_ns"] = np.rint(np.arange(n) / RATE * 1e9) + 1
    samples["f"] = [0.0, 0.0, -9.8] + force_std * rng.standard_normal((n, 3))
    samples["w"] = 0.1 + rate_std * rng.standard_normal((n, 3))
    return samples


def spoiled(kind):
    samples = window()
    if kind == "gravity removed":
        samples["f"] += [0.0, 0.0, 9.8]
    elif kind == "g":
        samples["f"] /= 9.80665
    elif kind == "millig":
        samples["f"] *= 10.0
    elif kind == "frozen":
        samples["f"], samples["w"] = samples["f"][0], samples["w"][0]
    elif kind == "saturated force":
        samples["f"] = np.clip(samples["f"] * 3.0, -25.0, 25.0)
    elif kind == "saturated rate":
        samples["w"] = np.clip(samples["w"] * 40.0, -4.0, 4.0)
    elif kind == "spike":
        samples["f"][50] += 80.0
    elif kind == "degrees":
        # One turn of 60° about a level axis, told as 60 rad.
        t = samples["t_ns"] * 1e-9
        samples["w"] = [np.degrees(np.radians(60.0)), 0.0, 0.0]
        angle = np.radians(60.0) * t
        samples["f"] = -9.8 * np.stack((0.0 * t, np.sin(angle), np.cos(angle)), axis=1)
        samples["w"] += 1e-3 * np.arange(len(t))[:, None] % 7e-3
    return samples


@pytest.mark.parametrize(
    ("kind", "name", "words"),
    [
        ("gravity removed", "imu: no gravity", "specific force"),
        ("g", "imu: no gravity", "9.80665"),
        ("millig", "imu: too much gravity", "m/s²"),
        ("frozen", "imu: frozen", "restart the driver"),
        ("saturated force", "imu: saturated acceleration", "25.00"),
        ("saturated rate", "imu: saturated rate", "4.00"),
        ("spike", "imu: spikes in acceleration", "cables"),
        ("degrees", "imu: degrees", "radians"),
    ],
)
def test_faults_are_named_with_value_and_remedy(kind: str, name: str, words: str) -> None:
    fault = find_fault(spoiled(kind))
    assert fault is not None and name_of_fault(fault) == name
    assert words in describe_fault(fault)


@pytest.mark.parametrize("peak", [5.0, 6.0, 8.0])
@pytest.mark.parametrize("begin", [-0.2, 0.1, 0.6])
def test_a_turn_beyond_the_range_is_missing_by_about_what_it_would_have_been(
    peak: float, begin: float
) -> None:
    # GIVEN a flip of 0.6 s, of which the window may contain a part, and a range of 4 rad/s
    samples = window(rate_std=0.01)
    t = samples["t_ns"] * 1e-9
    flip = peak * np.sin(np.pi * (t - begin) / 0.6) * (abs(t - begin - 0.3) < 0.3)
    samples["w"][:, 1] += flip
    lost = np.sum(np.maximum(np.abs(samples["w"][:, 1]) - 4.0, 0.0)) / RATE
    samples["w"] = np.clip(samples["w"], -4.0, 4.0)

    fault = find_fault(samples)

    assert fault is not None
    assert 0.5 * lost < fault.lost_turn < 4.0 * lost


def test_a_turn_beyond_the_range_is_graver_than_a_force_beyond_it() -> None:
    samples = spoiled("saturated force")
    samples["w"][50:, 0] = 4.36

    fault = find_fault(samples)

    assert fault is not None and fault.kind is FaultKind.SATURATED_RATE
    assert fault.lost_turn > 1.0


def test_vibration_beyond_the_range_hides_hardly_any_turn() -> None:
    samples = window()
    samples["w"] = np.clip(samples["w"] * 60.0 - 6.0, -4.0, 4.0)

    fault = find_fault(samples)

    assert fault is not None and fault.kind is FaultKind.SATURATED_RATE
    assert fault.lost_turn < 0.2


@pytest.mark.parametrize(
    ("bounce", "shake"), [(14.0, 0.5), (8.0, 4.0), (0.0, 8.0)], ids=["trot", "both", "vibration"]
)
def test_a_force_beyond_the_range_is_missing_along_its_axis_alone(
    bounce: float, shake: float
) -> None:
    # GIVEN a trot at 5 Hz, or vibration, and a range of 2 g
    samples = window(force_std=0.5)
    t = samples["t_ns"] * 1e-9
    rng = np.random.default_rng(1)
    samples["f"][:, 2] += bounce * np.sin(2.0 * np.pi * 5.0 * t) + rng.normal(0.0, shake, len(t))
    lost = np.sum(np.maximum(-samples["f"][:, 2] - 19.6, 0.0)) / RATE
    samples["f"] = np.clip(samples["f"], -19.6, 19.6)

    fault = find_fault(samples)

    assert fault is not None and fault.kind is FaultKind.SATURATED_FORCE
    assert fault.lost_speed[:2] == (0.0, 0.0)
    assert 0.7 * lost < fault.lost_speed[2] < 3.0 * lost


def test_vibration_beyond_both_ends_of_the_range_loses_as_much_to_as_fro() -> None:
    samples = window()
    samples["f"][:, 0] += 30.0 * np.sin(2.0 * np.pi * 31.0 * samples["t_ns"] * 1e-9)
    lost = np.sum(np.maximum(np.abs(samples["f"][:, 0]) - 16.0, 0.0)) / RATE
    samples["f"] = np.clip(samples["f"], -16.0, 16.0)

    fault = find_fault(samples)

    assert fault is not None and fault.lost_speed[1:] == (0.0, 0.0)
    assert 0.0 < fault.lost_speed[0] < 0.3 * lost


@pytest.mark.parametrize("rpy", [(np.pi, 0.0, 0.0), (0.0, np.pi / 2.0, 0.0), (0.1, 0.35, 2.0)])
@pytest.mark.parametrize("kind", ["saturated force", "saturated rate"])
def test_a_limit_is_one_of_the_imus_own_axes_however_it_is_mounted(
    kind: str, rpy: tuple[float, float, float]
) -> None:
    # GIVEN an IMU that is mounted upside down, sideways or askew
    own, mount = spoiled(kind), mount_matrix(rpy)
    samples = own.copy()
    samples["f"], samples["w"] = own["f"] @ mount.T, own["w"] @ mount.T

    fault, by_own = find_fault(samples, mount), find_fault(own)

    # THEN its limit is found as along b, and what it lacks is told along b
    assert fault is not None and by_own is not None
    assert fault == by_own
    assert fault.lost_turn == pytest.approx(by_own.lost_turn)
    lost, lost_b = np.square(by_own.lost_speed), np.square(fault.lost_speed)
    assert lost_b.sum() == pytest.approx(lost.sum())
    assert lost_b == pytest.approx(mount**2 @ lost)


@pytest.mark.parametrize("resolution", [np.radians(250.0) / 128.0, 0.01])
@pytest.mark.parametrize("rest", [0.0, 0.45, 0.5])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_steady_turn_is_no_limit_of_a_coarse_gyroscope(
    resolution: float, rest: float, side: float
) -> None:
    # GIVEN a turn whose rate lies between two readings
    samples = window()
    noise = 0.1 * resolution * np.random.default_rng(1).standard_normal((int(RATE), 3))
    turn = noise + side * (np.floor(2.7 / resolution) + rest) * resolution * np.array([0, 0, 1])
    samples["w"] = np.round(turn / resolution) * resolution

    # THEN readings that stay at the largest one are at no limit
    largest = np.abs(samples["w"][:, 2]).max()
    assert np.sum(np.abs(samples["w"][:, 2]) == largest) >= 10
    assert find_fault(samples) is None

    # WHEN it is faster for half a second THEN those are
    limit = np.floor(3.5 / resolution)
    turn[50:150, 2] += side * 3.0 * np.sin(np.pi * np.arange(100) / 100.0)
    samples["w"] = np.clip(np.round(turn / resolution), -limit, limit)
    samples["w"] *= resolution
    fault = find_fault(samples)
    assert fault is not None and fault.kind is FaultKind.SATURATED_RATE


@pytest.mark.parametrize("noise", [(0.02, 0.002), (0.5, 0.05), (5.0, 0.5)])
def test_sound_readings_have_none(noise: tuple[float, float]) -> None:
    assert find_fault(window(*noise)) is None


def test_propellers_are_no_spikes(flights: Path) -> None:
    from tools.field.flights import load

    flight = load(flights, 20, 1)
    samples = np.zeros(len(flight.stamp_ns), SAMPLE_DTYPE)
    samples["t_ns"] = flight.stamp_ns
    samples["f"], samples["w"] = flight.force, flight.rate
    found = [find_fault(samples[k : k + 120]) for k in range(0, len(samples) - 120, 60)]
    assert not any(found)


def test_a_few_samples_tell_nothing() -> None:
    assert find_fault(window()[:5]) is None


@pytest.mark.parametrize(("thrust", "is_fault"), [(9.8, True), (13.0, False), (4.0, False)])
def test_thrust_that_is_not_gravity_shows_no_degrees(thrust: float, is_fault: bool) -> None:
    """A flip with constant thrust: the force stays along z, however the body turns."""
    samples = spoiled("degrees")
    samples["f"] = [0.0, 0.0, -thrust]
    samples["f"] += 1e-3 * np.arange(len(samples))[:, None] % 7e-3
    samples["w"][:, 0] = 3.5
    samples["w"] += 1e-3 * np.arange(len(samples))[:, None] % 7e-3

    assert (find_fault(samples) is not None) is is_fault
