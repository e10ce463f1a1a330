"""The filters that are measured: this one, one in careful NumPy, filterpy and GTSAM."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.inertial import propagation
from hybrid_ins.core.inertial.earth import curvature_scale
from hybrid_ins.core.inertial.rotations import matrix_from_quat
from hybrid_ins.core.inertial.state import LAST_F, LAST_W, LLA, PSD, covariance
from hybrid_ins.core.update.iterated_update import update
from hybrid_ins.core.update.measurements import PositionFix
from tools.benchmark.careful_numpy import CarefulFilter
from tools.paper.runs import Run

Array = NDArray[np.float64]
LEVER = np.zeros(3)
RATE, FIX_RATE = 200.0, 5.0  # Hz


class Contender(Protocol):
    """A filter of some make, at the start of a run."""

    def block(self, dt: list[float], readings: list[list[float]]) -> None:
        """Take IMU samples: steps [s] and readings (specific force, angular rate)."""
        ...

    def fix(self, fix: PositionFix) -> None:
        """Fuse a position."""
        ...

    def lla(self) -> Array:
        """Return the position, shape (3,)."""
        ...

    def P(self) -> Array | None:
        """Return the covariance in this project's order of states, if there is one."""
        ...


class Compiled:
    """The project's step and update; ``batch``: many samples in one call, as for recordings."""

    def __init__(self, run: Run, batch: bool, interval: float) -> None:
        self.nav = run.start.to_flat()
        first = run.samples[0]
        self.nav[LAST_F], self.nav[LAST_W] = first["f"], first["w"]
        self.nav[PSD] = psd(run)
        self._interval = interval
        self.block = self._batch if batch else self._live

    def _live(self, dt: list[float], readings: list[list[float]]) -> None:
        step, nav, interval = propagation.step, self.nav, self._interval
        for t, (fx, fy, fz, wx, wy, wz) in zip(dt, readings, strict=True):
            step(nav, t, fx, fy, fz, wx, wy, wz, interval)

    def _batch(self, dt: Any, readings: Any) -> None:
        propagation.run(self.nav, dt, readings, self._interval, propagation.NO_ROWS)

    def fix(self, fix: PositionFix) -> None:
        """See `Contender`."""
        propagation.propagate_covariance(self.nav)
        z, H, R = fix.linearise(self.nav)
        update(self.nav, z, H, R)

    def lla(self) -> Array:
        """See `Contender`."""
        return self.nav[LLA]

    def P(self) -> Array:
        """See `Contender`."""
        propagation.propagate_covariance(self.nav)
        return covariance(self.nav)


class Careful:
    """`careful_numpy`."""

    def __init__(self, run: Run) -> None:
        start = run.start
        self.filter = self._make(
            start.lla, start.velocity_n, start.quat_xyzw, start.P, reading(run, 0), psd(run)
        )

    _make: Callable[..., CarefulFilter] = CarefulFilter

    def block(self, dt: list[float], readings: list[list[float]]) -> None:
        """See `Contender`."""
        step = self.filter.step
        for t, values in zip(dt, readings, strict=True):
            step(t, values)

    def fix(self, fix: PositionFix) -> None:
        """See `Contender`."""
        self.filter.update(fix.lla, fix.covariance_n, LEVER)

    def lla(self) -> Array:
        """See `Contender`."""
        return np.array(self.filter.lla)

    def P(self) -> Array:
        """See `Contender`."""
        return self.filter.P


class _FilterpyFilter(CarefulFilter):
    """The same mechanisation and F, with filterpy's Kalman filter for the error state."""

    def __init__(self, *args: Any) -> None:
        from filterpy.kalman import KalmanFilter

        super().__init__(*args)
        self._kalman = KalmanFilter(dim_x=15, dim_z=3)
        self._kalman.P = self.P
        self._Qc = np.diag(np.concatenate((np.zeros(3), self.psd)))

    def _propagate(self, dt: float) -> None:
        kalman, C = self._kalman, self._C
        self._Qc[3:6, 3:6] = C * self.psd[:3] @ C.T
        self._Qc[6:9, 6:9] = C * self.psd[3:6] @ C.T
        kalman.predict(F=self._identity + self.F * dt, Q=self._Qc * dt)
        self.P = kalman.P

    def _correction(self, z: Array, H: Array, R: Array) -> Array:
        kalman = self._kalman
        kalman.x = np.zeros((15, 1))
        kalman.update(z.reshape(3, 1), R=R, H=H)
        self.P = kalman.P
        return kalman.x.ravel()


class Filterpy(Careful):
    """filterpy's `KalmanFilter` inside the careful mechanisation."""

    _make = _FilterpyFilter


class Gtsam:
    """
    GTSAM: combined IMU preintegration between fixes, ISAM2 over them, on a flat Earth.

    Its frames are this project's: NED at the first position, FRD.
    """

    def __init__(self, run: Run) -> None:
        import gtsam

        self._gtsam = gtsam
        self._origin = run.start.lla
        self._metres = curvature_scale(self._origin)
        density = psd(run)
        settings = gtsam.PreintegrationCombinedParams.MakeSharedD(9.795)
        settings.setAccelerometerCovariance(np.diag(density[:3]))
        settings.setGyroscopeCovariance(np.diag(density[3:6]))
        settings.setBiasAccCovariance(np.diag(density[6:9]))
        settings.setBiasOmegaCovariance(np.diag(density[9:]))
        settings.setIntegrationCovariance(1e-10 * np.eye(3))
        start = run.start
        pose = gtsam.Pose3(gtsam.Rot3(matrix_from_quat(start.quat_xyzw)), np.zeros(3))
        bias = gtsam.imuBias.ConstantBias()
        std = np.sqrt(np.diag(start.P))
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        noise = gtsam.noiseModel.Diagonal.Sigmas
        graph.add(
            gtsam.PriorFactorPose3(
                self._key("x", 0), pose, noise(np.concatenate((std[6:9], std[:3])))
            )
        )
        graph.add(gtsam.PriorFactorVector(self._key("v", 0), start.velocity_n, noise(std[3:6])))
        graph.add(gtsam.PriorFactorConstantBias(self._key("b", 0), bias, noise(std[9:])))
        values.insert(self._key("x", 0), pose)
        values.insert(self._key("v", 0), start.velocity_n)
        values.insert(self._key("b", 0), bias)
        self._isam = gtsam.ISAM2()
        self._isam.update(graph, values)
        self._state, self._bias = gtsam.NavState(pose, start.velocity_n), bias
        self._between = gtsam.PreintegratedCombinedMeasurements(settings, bias)
        self._count = 0

    def _key(self, letter: str, k: int) -> int:
        return int(self._gtsam.symbol(letter, k))

    def block(self, dt: Any, readings: Any) -> None:
        """See `Contender`."""
        integrate = self._between.integrateMeasurement
        # It holds a reading over the step: the mean of the step's two ends is the fair one.
        for t, values in zip(dt, readings, strict=True):
            integrate(values[:3], values[3:], t)

    def fix(self, fix: PositionFix) -> None:
        """See `Contender`."""
        gtsam, k = self._gtsam, self._count + 1
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        graph.add(
            gtsam.CombinedImuFactor(
                self._key("x", k - 1),
                self._key("v", k - 1),
                self._key("x", k),
                self._key("v", k),
                self._key("b", k - 1),
                self._key("b", k),
                self._between,
            )
        )
        position = (fix.lla - self._origin) * self._metres
        graph.add(
            gtsam.GPSFactor(
                self._key("x", k), position, gtsam.noiseModel.Gaussian.Covariance(fix.covariance_n)
            )
        )
        guess = self._between.predict(self._state, self._bias)
        values.insert(self._key("x", k), guess.pose())
        values.insert(self._key("v", k), guess.velocity())
        values.insert(self._key("b", k), self._bias)
        self._isam.update(graph, values)
        best = self._isam.calculateEstimate
        self._state = gtsam.NavState(
            self._isam.calculateEstimatePose3(self._key("x", k)),
            self._isam.calculateEstimateVector(self._key("v", k)),
        )
        self._bias = best().atConstantBias(self._key("b", k))
        self._between.resetIntegrationAndSetBias(self._bias)
        self._count = k

    def lla(self) -> Array:
        """See `Contender`."""
        state = self._between.predict(self._state, self._bias)
        return self._origin + np.asarray(state.position()) / self._metres

    def P(self) -> None:
        """See `Contender`."""


def psd(run: Run) -> Array:
    """Return the true Qc of a run, shape (12,)."""
    return np.concatenate((run.q[0] / RATE, run.bias_walk))


def reading(run: Run, k: int) -> list[float]:
    """Return one IMU sample as six numbers."""
    sample = run.samples[k]
    return [*sample["f"].tolist(), *sample["w"].tolist()]
