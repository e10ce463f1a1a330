"""
A trajectory as arrays: many nav_msgs/Odometry messages in one object.

It keeps the message's frames (REP-105): ``map``, east-north-up at the datum, and ``base_link``,
forward-left-up. Estimates, truth and simulations are compared in this form, so that what is
evaluated is what a subscriber receives.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.inertial import rotations
from hybrid_ins.core.inertial.earth import LocalFrame
from hybrid_ins.ros.messages.conversions import SWAP

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

_QUAT_FRD_FLU = np.array([1.0, 0.0, 0.0, 0.0])  # half a turn about x
_MOVED = 1.0  # m: a vehicle that travelled this far had a velocity


@dataclass(frozen=True, eq=False)
class Trajectory:
    """
    Position, velocity and attitude at given epochs.

    An unknown part is None, an unknown row of a part is NaN. Covariances are those of true minus
    estimated, as in Odometry: position along the map axes, attitude as a small rotation about the
    map axes, velocity along the axes of base_link, including the share of the attitude's
    uncertainty.
    """

    stamp_ns: Stamps  # (N,)
    position_enu: Array  # (N, 3) m, map
    velocity_enu: Array | None = None  # (N, 3) m/s, over ground, map axes
    quat_xyzw: Array | None = None  # (N, 4) rotates base_link (FLU) to map
    position_cov: Array | None = None  # (N, 3, 3) m^2
    velocity_cov: Array | None = None  # (N, 3, 3) (m/s)^2, of `velocity_base`
    attitude_cov: Array | None = None  # (N, 3, 3) rad^2
    datum_lla: Array | None = None  # (3,) rad, rad, m: the map's origin, where known

    def __len__(self) -> int:
        return len(self.stamp_ns)

    @classmethod
    def from_navigation(
        cls,
        stamp_ns: Stamps,
        lla: Array,
        velocity_n: Array | None = None,
        quat_nb_xyzw: Array | None = None,
        *,
        datum_lla: Array,
    ) -> Trajectory:
        """
        Build a trajectory from the filter's arrays (NED, FRD).

        Parameters
        ----------
        stamp_ns : ndarray, shape (N,)
            Time stamps [ns].
        lla : ndarray, shape (N, 3)
            Latitude [rad], longitude [rad], ellipsoidal height [m].
        velocity_n : ndarray, shape (N, 3), optional
            Velocity over ground, NED [m/s].
        quat_nb_xyzw : ndarray, shape (N, 4), optional
            Body (FRD) to navigation frame (NED).
        datum_lla : ndarray, shape (3,)
            Origin of the map.

        """
        frame = LocalFrame(datum_lla)
        # The axes of the navigation frame depend on the position; those of the map do not.
        C_map_n = SWAP @ np.array([frame.C_from_n(place) for place in lla]).reshape(-1, 3, 3)

        return cls(
            np.asarray(stamp_ns, np.int64),
            frame.position(lla) @ SWAP,
            None if velocity_n is None else (C_map_n @ velocity_n[..., None])[..., 0],
            None
            if quat_nb_xyzw is None
            else rotations.quat_multiply(
                rotations.quat_from_matrix(C_map_n),
                rotations.quat_multiply(quat_nb_xyzw, _QUAT_FRD_FLU),
            ),
            datum_lla=frame.datum_lla,
        )

    @property
    def velocity_base(self) -> Array | None:
        """Velocity over ground along the base_link axes (FLU), shape (N, 3) [m/s]."""
        if self.velocity_enu is None or self.quat_xyzw is None:
            return None
        C_map_base = rotations.matrix_from_quat(self.quat_xyzw)
        velocity: Array = np.einsum("nij,ni->nj", C_map_base, self.velocity_enu)
        return velocity

    def rows(self, keep: NDArray[np.bool_] | NDArray[np.int64] | slice) -> Trajectory:
        """Return the epochs that `keep` selects."""
        return self._with_arrays(
            {name: None if a is None else a[keep] for name, a in self._arrays().items()}
        )

    def in_order(self) -> tuple[Trajectory, int]:
        """
        Sort by stamp and keep the last of equal stamps (after a correction, not before it).

        Returns
        -------
        Trajectory
            With strictly increasing stamps.
        int
            How many epochs were dropped.

        """
        order = np.argsort(self.stamp_ns, kind="stable")
        last = np.append(np.diff(self.stamp_ns[order]) > 0, True) if len(order) else order
        return self.rows(order[last]), int(len(order) - np.sum(last))

    def bracket_ns(self, stamp_ns: Stamps) -> Stamps:
        """
        Return the distance of the two epochs that enclose each stamp.

        0 where an epoch has that very stamp, -1 where the stamp lies outside.
        """
        if len(self) < 2:
            return np.full(len(stamp_ns), -1, np.int64)
        right = np.clip(np.searchsorted(self.stamp_ns, stamp_ns), 1, len(self) - 1)
        gap = self.stamp_ns[right] - self.stamp_ns[right - 1]
        inside = (stamp_ns >= self.stamp_ns[0]) & (stamp_ns <= self.stamp_ns[-1])
        gap[(stamp_ns == self.stamp_ns[right]) | (stamp_ns == self.stamp_ns[right - 1])] = 0
        return np.where(inside, gap, -1)

    def at(self, stamp_ns: Stamps) -> Trajectory:
        """
        Interpolate to other stamps, all within the trajectory; its stamps must increase strictly.

        Position by the cubic Hermite polynomial of position and velocity at both ends (a straight
        line where the velocity is unknown), velocity and covariances linearly, attitude along the
        shortest rotation. Exact for a constant acceleration and a constant turn rate.

        Raises
        ------
        ValueError
            A stamp lies outside the trajectory, or that has fewer than two epochs.

        """
        if np.any(self.bracket_ns(stamp_ns) < 0):
            raise ValueError("stamps outside the trajectory")
        right = np.clip(np.searchsorted(self.stamp_ns, stamp_ns), 1, len(self) - 1)
        left = right - 1
        dt = (self.stamp_ns[right] - self.stamp_ns[left])[:, None] * 1e-9
        u = (stamp_ns - self.stamp_ns[left])[:, None] * 1e-9 / dt

        def linear(values: Array | None) -> Array | None:
            if values is None:
                return None
            weight = u.reshape(-1, *[1] * (values.ndim - 1))
            with np.errstate(invalid="ignore"):  # a covariance may be infinite
                return (1.0 - weight) * values[left] + weight * values[right]

        position = linear(self.position_enu)
        assert position is not None
        if self.velocity_enu is not None:
            slope = (self.position_enu[right] - self.position_enu[left]) / dt
            start, stop = self.velocity_enu[left] - slope, self.velocity_enu[right] - slope
            cubic = dt * u * (1.0 - u) * ((1.0 - u) * start - u * stop)
            position = position + np.where(np.isfinite(cubic), cubic, 0.0)
        quat = self.quat_xyzw
        return Trajectory(
            stamp_ns,
            position,
            linear(self.velocity_enu),
            None if quat is None else rotations.slerp(quat[left], quat[right], u[:, 0]),
            linear(self.position_cov),
            linear(self.velocity_cov),
            linear(self.attitude_cov),
            self.datum_lla,
        )

    def in_map_of(self, datum_lla: Array) -> Trajectory:
        """
        Express the trajectory in the map of another datum, exactly (the axes differ, too).

        Raises
        ------
        ValueError
            The trajectory's own datum is unknown.

        """
        if self.datum_lla is None:
            raise ValueError("a trajectory without a datum cannot be expressed in another map")
        if np.array_equal(self.datum_lla, datum_lla):
            return self
        old, new = LocalFrame(self.datum_lla), LocalFrame(datum_lla)
        C_new_old = SWAP @ new.C_en.T @ old.C_en @ SWAP
        quat = self.quat_xyzw

        def turned(covariance: Array | None) -> Array | None:
            return None if covariance is None else _rotated(C_new_old, covariance)

        return Trajectory(
            self.stamp_ns,
            new.position(old.lla(self.position_enu @ SWAP)) @ SWAP,
            None if self.velocity_enu is None else self.velocity_enu @ C_new_old.T,
            None
            if quat is None
            else rotations.quat_multiply(rotations.quat_from_matrix(C_new_old), quat),
            turned(self.position_cov),
            self.velocity_cov,
            turned(self.attitude_cov),
            np.asarray(datum_lla, float),
        )

    def _arrays(self) -> dict[str, Array | None]:
        return {name: value for name, value in vars(self).items() if name != "datum_lla"}

    def _with_arrays(self, arrays: dict[str, Array | None]) -> Trajectory:
        return replace(self, **arrays)  # type: ignore[arg-type]


def enu_from_lla(lla: Array, datum_lla: Array) -> Array:
    """Return positions in the map of `datum_lla`, shape (N, 3) [m], of geodetic ones (N, 3)."""
    position: Array = LocalFrame(datum_lla).position(lla) @ SWAP
    return position


def trajectory_from_odometry(stamp_ns: Stamps, rows: Array) -> tuple[Trajectory, list[str]]:
    """
    Build a trajectory from the numbers of nav_msgs/Odometry messages.

    Parameters
    ----------
    stamp_ns : ndarray, shape (N,)
        Header stamps.
    rows : ndarray, shape (N, 85)
        The message's doubles in its own order: position, quaternion, pose covariance, linear and
        angular velocity in base_link, twist covariance.

    Returns
    -------
    Trajectory
        In the order of the stamps; parts that the messages do not hold are None.
    faults : list of str
        What was left out and why.

    """
    faults: list[str] = []

    def drop(bad: NDArray[np.bool_], why: str) -> None:
        nonlocal stamp_ns, rows
        if np.any(bad):
            faults.append(f"{np.sum(bad)} of {len(bad)} messages ignored: {why}")
            stamp_ns, rows = stamp_ns[~bad], rows[~bad]

    drop(stamp_ns <= 0, "no time stamp")
    drop(np.asarray(~np.isfinite(rows[:, :3]).all(axis=1)), "NaN or infinity in the position")

    with np.errstate(invalid="ignore", over="ignore"):
        norm = np.linalg.norm(rows[:, 3:7], axis=1, keepdims=True)
        quat = np.where((norm > 0.5) & (norm < 2.0), rows[:, 3:7] / norm, np.nan)
    C_map_base = rotations.matrix_from_quat(quat)
    invalid = np.isnan(quat).any(axis=1)
    if np.any(invalid):
        faults.append(
            f"{np.sum(invalid)} of {len(quat)} quaternions are invalid (zero or not finite):"
            " no attitude and no velocity at these stamps"
        )
    velocity_base = rows[:, 43:46]
    extent = np.ptp(rows[:, :3], axis=0) if len(rows) else np.zeros(3)
    no_velocity = not np.any(velocity_base) and bool(np.linalg.norm(extent) > _MOVED)
    if no_velocity:
        faults.append("every velocity is zero although the vehicle moves: treated as unknown")
    pose_cov = rows[:, 7:43].reshape(-1, 6, 6)
    twist_cov = rows[:, 49:85].reshape(-1, 6, 6)
    velocity = (C_map_base @ velocity_base[..., None])[..., 0]
    trajectory, repeated = Trajectory(
        stamp_ns,
        rows[:, :3],
        None if no_velocity else _none_if_unknown(velocity),
        _none_if_unknown(quat),
        _none_if_unset(pose_cov[:, :3, :3]),
        None if no_velocity else _none_if_unset(twist_cov[:, :3, :3]),
        _none_if_unset(pose_cov[:, 3:, 3:]),
    ).in_order()
    if np.any(np.diff(stamp_ns) < 0):
        faults.append("time stamps go backward: messages were sorted (did the bag loop?)")
    if repeated:
        faults.append(f"{repeated} messages repeat a time stamp: the last of each was used")
    return trajectory, faults


def _none_if_unknown(values: Array) -> Array | None:
    return values if np.any(np.isfinite(values)) else None


def _none_if_unset(covariance: Array) -> Array | None:
    """Return None for covariances that are all zero or not finite."""
    return covariance if np.any(np.nan_to_num(covariance, posinf=0.0, neginf=0.0)) else None


def _rotated(C: Array, covariance: Array) -> Array:
    rotated: Array = C @ covariance @ np.swapaxes(C, -1, -2)
    return rotated
