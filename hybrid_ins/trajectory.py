"""
A vehicle's motion as arrays: what estimates, truth and simulations are compared as.

A `Trajectory` is `nav_msgs/Odometry` in bulk and keeps its frames (REP-105): ``map``, east-north-up at
the datum, and ``base_link``, forward-left-up. What is judged is what a subscriber receives.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core import rotations
from hybrid_ins.core.earth import LocalFrame
from hybrid_ins.core.state import DP, DV, EPS
from hybrid_ins.ros.conversions import SWAP

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

_QUAT_FRD_FLU = np.array([1.0, 0.0, 0.0, 0.0])  # half a turn about x


@dataclass(frozen=True, eq=False)
class Trajectory:
    """
    Motion at given epochs. A part that is unknown is None, an unknown row of it is NaN.

    Covariances are those of true minus estimated, as Odometry has them: position along the map
    axes, attitude as a small rotation about the map axes, velocity along the vehicle's own axes,
    with what the attitude's uncertainty adds to it.
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
        covariance: Array | None = None,
        *,
        datum_lla: Array,
    ) -> Trajectory:
        """
        Build a track from the filter's own arrays (NED, FRD).

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
        covariance : ndarray, shape (N, M, M), M >= 9, optional
            Of the error state: position [m], velocity [m/s], misalignment [rad], all NED.
        datum_lla : ndarray, shape (3,)
            Origin of the map.

        """
        frame = LocalFrame(datum_lla)
        # The navigation frame turns with the place it is at; the map does not.
        C_map_n = SWAP @ np.array([frame.C_from_n(place) for place in lla]).reshape(-1, 3, 3)

        def block(part: slice) -> Array | None:
            return None if covariance is None else _rotated(C_map_n, covariance[:, part, part])

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
            block(DP),
            _velocity_base_cov(velocity_n, quat_nb_xyzw, covariance),
            block(EPS),
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
        Interpolate to other stamps, all within the track; stamps must increase strictly.

        Position by a cubic that meets position and velocity at both ends (a straight line where
        the velocity is unknown), velocity and covariances linearly, attitude along the shortest
        turn. A constant acceleration and a constant turn rate are met exactly.

        Raises
        ------
        ValueError
            A stamp lies outside the track, or the track has fewer than two epochs.

        """
        if np.any(self.bracket_ns(stamp_ns) < 0):
            raise ValueError("stamps outside the track")
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
            bend = dt * u * (1.0 - u) * ((1.0 - u) * start - u * stop)
            position = position + np.where(np.isfinite(bend), bend, 0.0)
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
        Express the track in the map of another datum, exactly (the axes differ, too).

        Raises
        ------
        ValueError
            The track's own datum is unknown.

        """
        if self.datum_lla is None:
            raise ValueError("a track without a datum cannot change its map")
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
    """Position in the map of `datum_lla`, shape (N, 3) [m], of geodetic places (N, 3)."""
    position: Array = LocalFrame(datum_lla).position(lla) @ SWAP
    return position


def _velocity_base_cov(
    velocity_n: Array | None, quat_nb_xyzw: Array | None, covariance: Array | None
) -> Array | None:
    """Covariance of C_bn v_n along FLU axes: its error is C_bn (dv - [v x] eps)."""
    if velocity_n is None or quat_nb_xyzw is None or covariance is None:
        return None
    C_flu_n = np.swapaxes(
        rotations.matrix_from_quat(rotations.quat_multiply(quat_nb_xyzw, _QUAT_FRD_FLU)), -1, -2
    )
    J = np.zeros((len(velocity_n), 3, covariance.shape[-1]))
    J[:, :, DV] = C_flu_n
    J[:, :, EPS] = -C_flu_n @ rotations.skew(velocity_n)
    return _rotated(J, covariance)


def _rotated(C: Array, covariance: Array) -> Array:
    rotated: Array = C @ covariance @ np.swapaxes(C, -1, -2)
    return rotated
