"""
Odometry of a running filter, in ``map`` and in ``odom``, sample by sample or in blocks.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.imu.samples import steps_since
from hybrid_ins.ros.messages.conversions import MapFrame
from hybrid_ins.ros.output import odom_frame, output
from hybrid_ins.ros.reporting.reports import Odometry, OdometryBlock

Array = NDArray[np.float64]


class OdometrySource:
    """
    Makes odometry of the filter's flat state; ``odom`` goes on over restarts.

    Attributes
    ----------
    map : MapFrame or None
        The map, once there is a datum: nothing is to be made before.
    """

    def __init__(self) -> None:
        self.map: MapFrame | None = None
        self._odom = odom_frame.start()
        self._last_ns = 0  # of the last sample in odom; 0: the filter has just started

    def restart(self) -> None:
        """Restart, as the filter did: ``odom`` keeps its pose."""
        self._last_ns = 0

    def make(self, t_ns: int, nav: Array, arm_b: Array, rate_variance: Array) -> Odometry | None:
        """
        Return the odometry after a sample; None where the state is not finite.

        Parameters
        ----------
        t_ns : int
            Stamp [ns].
        nav : ndarray, shape (N_NAV,) or longer
            Flat state of the IMU.
        arm_b : ndarray, shape (3,)
            IMU relative to the base frame's origin [m], b.
        rate_variance : ndarray, shape (3,)
            Of one gyroscope reading [(rad/s)²], b.
        """
        in_map, in_odom = self.in_map(nav, arm_b, rate_variance), np.empty(output.N_ODOMETRY)
        if not math.isfinite(in_map.item(3) + in_map.item(7)):
            return None
        dt = (t_ns - self._last_ns) * 1e-9 if self._last_ns else 0.0
        self._last_ns = t_ns
        odom_frame.advance(self._odom, dt, in_map, in_odom)
        return Odometry(t_ns, in_map, in_odom)

    def in_map(self, nav: Array, arm_b: Array, rate_variance: Array) -> Array:
        """Return the numbers (85,) of an Odometry message in ``map``; see `make`."""
        assert self.map is not None
        values = np.empty(output.N_ODOMETRY)
        output.odometry_values(nav, self.map.origin_e, self.map.C_me, arm_b, rate_variance, values)
        return values

    def make_block(
        self, t_ns: NDArray[np.int64], rows: Array, arm_b: Array, rate_variance: Array
    ) -> OdometryBlock | None:
        """Return the same of many samples: stamps (N,) and flat states (N, N_NAV)."""
        assert self.map is not None
        in_map = np.empty((len(t_ns), output.N_ODOMETRY))
        in_odom = np.empty_like(in_map)
        output.odometry_block(rows, self.map.origin_e, self.map.C_me, arm_b, rate_variance, in_map)
        if not np.isfinite(in_map).all():
            return None
        dt = steps_since(self._last_ns or int(t_ns[0]), t_ns) * 1e-9
        self._last_ns = int(t_ns[-1])
        odom_frame.advance_block(self._odom, dt, in_map, in_odom)
        return OdometryBlock(t_ns, in_map, in_odom)
