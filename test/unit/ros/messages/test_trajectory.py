"""Tracks: interpolation that is exact where it can be, and maps that differ."""

import numpy as np
import pytest

from hybrid_ins.core.inertial import rotations
from hybrid_ins.core.inertial.earth import LocalFrame
from hybrid_ins.ros.messages.conversions import SWAP
from hybrid_ins.ros.messages.trajectory import Trajectory, enu_from_lla

DATUM = np.array([np.radians(32.1), np.radians(34.8), 20.0])


def stamps(seconds: np.ndarray) -> np.ndarray:
    return 1_700_000_000_000_000_000 + np.rint(1e9 * np.asarray(seconds)).astype(np.int64)


def moving(seconds: np.ndarray) -> Trajectory:
    """Constant acceleration and a constant turn rate about a tilted axis."""
    t = np.asarray(seconds)[:, None]
    velocity, acceleration = np.array([3.0, -2.0, 0.5]), np.array([1.0, 4.0, -0.3])
    start = rotations.quat_from_rpy(0.3, -0.2, 2.0)
    turn = rotations.quat_from_rotvec(t * np.array([0.2, -0.1, 1.5]))
    return Trajectory(
        stamps(seconds),
        velocity * t + 0.5 * acceleration * t**2,
        velocity + acceleration * t,
        rotations.quat_multiply(start, turn),
        (1.0 + t[..., None]) * np.eye(3),
        (2.0 + t[..., None]) * np.eye(3),
        (3.0 + t[..., None]) * np.eye(3),
        DATUM,
    )


def test_interpolation_is_exact_for_constant_acceleration_and_turn_rate() -> None:
    between = np.random.default_rng(0).uniform(0.0, 10.0, 200)

    found = moving(np.arange(0.0, 10.5, 0.5)).at(stamps(between))

    expected = moving(between)
    for name in ("position_enu", "velocity_enu", "position_cov", "velocity_cov", "attitude_cov"):
        # Stamps are whole nanoseconds: at 40 m/s that is 2e-8 m.
        assert getattr(found, name) == pytest.approx(getattr(expected, name), abs=1e-7), name
    assert found.quat_xyzw is not None
    assert expected.quat_xyzw is not None
    away = rotations.quat_multiply(rotations.quat_conjugate(found.quat_xyzw), expected.quat_xyzw)
    assert np.max(np.abs(rotations.rotvec_from_quat(away))) < 1e-7


def test_interpolation_at_own_epochs_returns_them() -> None:
    track = moving(np.arange(0.0, 5.0, 0.1))

    found = track.at(track.stamp_ns)

    assert found.position_enu == pytest.approx(track.position_enu, abs=1e-12)
    assert found.quat_xyzw == pytest.approx(track.quat_xyzw, abs=1e-12)


def test_interpolation_is_straight_where_the_velocity_is_unknown() -> None:
    position = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 4.0]])
    blind = Trajectory(stamps(np.array([0.0, 1.0])), position)
    gone = Trajectory(blind.stamp_ns, position, np.array([[1.0, 1.0, 1.0], [np.nan] * 3]))

    for track in (blind, gone):
        quarter = track.at(stamps(np.array([0.25])))
        assert quarter.position_enu[0] == pytest.approx([0.25, 0.5, 1.0])


@pytest.mark.parametrize("second", [-0.001, 5.001])
def test_nothing_is_extrapolated(second: float) -> None:
    track = moving(np.arange(0.0, 5.5, 0.5))

    with pytest.raises(ValueError, match="outside"):
        track.at(stamps(np.array([second])))


def test_in_order_sorts_and_keeps_the_last_of_equal_stamps() -> None:
    position = np.arange(12.0).reshape(4, 3)

    track, dropped = Trajectory(np.array([30, 10, 20, 10]), position).in_order()

    assert dropped == 1
    assert track.stamp_ns.tolist() == [10, 20, 30]
    assert track.position_enu[:, 0].tolist() == [9.0, 6.0, 0.0]


def test_another_datum_moves_the_track_exactly() -> None:
    there = np.array([DATUM[0] + 2e-3, DATUM[1] - 3e-3, DATUM[2] + 80.0])
    track = moving(np.arange(0.0, 20.0, 1.0))

    moved = track.in_map_of(there)
    back = moved.in_map_of(DATUM)

    # Both describe the same places on Earth, and the same directions.
    old, new = LocalFrame(DATUM), LocalFrame(there)
    lla_old, lla_new = old.lla(track.position_enu @ SWAP), new.lla(moved.position_enu @ SWAP)
    assert lla_new[:, :2] == pytest.approx(lla_old[:, :2], abs=1e-15)
    assert lla_new[:, 2] == pytest.approx(lla_old[:, 2], abs=1e-7)
    assert moved.velocity_enu is not None
    assert track.velocity_enu is not None
    velocity_e = track.velocity_enu @ SWAP @ old.C_en.T
    assert moved.velocity_enu @ SWAP @ new.C_en.T == pytest.approx(velocity_e, abs=1e-12)
    assert not np.allclose(moved.velocity_enu, track.velocity_enu, atol=1e-5)
    for name in ("position_enu", "velocity_enu", "quat_xyzw", "position_cov"):
        assert getattr(back, name) == pytest.approx(getattr(track, name), abs=1e-7), name


def test_a_track_without_datum_cannot_change_its_map() -> None:
    track = Trajectory(stamps(np.array([0.0, 1.0])), np.zeros((2, 3)))

    with pytest.raises(ValueError, match="datum"):
        track.in_map_of(DATUM)


def test_filter_arrays_become_a_track_in_enu_and_flu() -> None:
    frame = LocalFrame(DATUM)
    lla = frame.lla(np.array([[0.0, 0.0, 0.0], [100.0, 20.0, -5.0]]))
    heading_east = rotations.quat_from_rpy(0.0, 0.0, np.pi / 2)  # NED: nose to the east

    track = Trajectory.from_navigation(
        stamps(np.array([0.0, 1.0])),
        lla,
        np.array([[1.0, 2.0, 3.0], [1.0, 2.0, 3.0]]),
        np.array([heading_east, heading_east]),
        datum_lla=DATUM,
    )

    assert track.position_enu[1] == pytest.approx([20.0, 100.0, 5.0], abs=1e-6)
    assert track.position_enu == pytest.approx(enu_from_lla(lla, DATUM), abs=1e-9)
    assert track.velocity_enu is not None
    assert track.velocity_enu[0] == pytest.approx([2.0, 1.0, -3.0])
    assert track.quat_xyzw is not None
    assert np.abs(track.quat_xyzw[0]) == pytest.approx([0.0, 0.0, 0.0, 1.0])  # REP-103: yaw 0
    assert track.velocity_base is not None
    assert track.velocity_base[0] == pytest.approx([2.0, 1.0, -3.0])
    # 100 m further north the navigation frame has turned, if only by micro-radians.
    assert not np.allclose(track.velocity_enu[0], track.velocity_enu[1], rtol=0, atol=1e-6)
