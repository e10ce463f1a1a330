"""
The last seconds of an IMU's readings and of fixes, as motions whose changes of velocity compare.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.imu_axes.fit import INTERVALS, STEP, Motion, triples_of
from hybrid_ins.core.imu_axes.nuisance import CLOCK_OFFSETS
from hybrid_ins.core.inertial.earth import displacement

Array = NDArray[np.float64]

WINDOW, SHORTEST_WINDOW, LONG_WINDOW = 20.0, 12.0, 60.0  # s, of motion; the last without a finding
LEAST_CHANGE = (1.0, 0.4, 0.4)  # m/s, RMS of the changes of velocity over ``INTERVALS``
FEWEST_CHANGES = 8  # changes of velocity
MAX_FIXES = 1024  # that are kept


def is_long(motion: Motion) -> bool:
    """Return whether a motion is longer than `WINDOW`."""
    return bool(motion.t[-1] - motion.t[0] > WINDOW + SHORTEST_WINDOW)


class MotionWindow:
    """
    Gathers the readings, in the IMU's own axes, and the fixes.

    Parameters
    ----------
    mount : ndarray, shape (3, 3)
        From the IMU's own axes to b, the samples' frame.
    """

    def __init__(self, mount: Array) -> None:
        self._mount = mount
        self._last: NDArray[np.void] | None = None
        self._sums = np.zeros(6)  # at the last sample
        self._grid = np.empty((0, 7))  # s since the first sample, integrals of the readings
        self._fix_ns, self._fix_lla = np.empty(0, np.int64), np.empty((0, 3))
        self._start_ns = 0

    def add_samples(self, samples: NDArray[np.void]) -> None:
        """Add samples (``SAMPLE_DTYPE``, in b) that follow the last ones."""
        if not len(samples):
            return
        if self._last is None:
            self._start_ns = int(samples["t_ns"][0])
            self._grid = np.zeros((1, 7))
        else:
            samples = np.concatenate((self._last, samples))
        self._last = samples[-1:].copy()
        t = (samples["t_ns"] - self._start_ns) * 1e-9
        readings = np.hstack((samples["w"] @ self._mount, samples["f"] @ self._mount))
        sums = np.zeros((len(t), 6))
        sums[0] = self._sums
        steps = 0.5 * (readings[1:] + readings[:-1]) * np.diff(t)[:, None]
        sums[1:] = self._sums + np.cumsum(steps, axis=0)
        self._sums = sums[-1]
        first = round(self._grid[-1, 0] / STEP) + 1
        grid = STEP * np.arange(first, int(t[-1] / STEP + 1e-9) + 1)
        columns = [np.interp(grid, t, sums[:, k]) for k in range(6)]
        rows = np.column_stack((grid, *columns))
        most = round((LONG_WINDOW + 2.0) / STEP)
        self._grid = np.concatenate((self._grid, rows))[-most:]

    def add_fix(self, t_ns: int, lla: Array) -> None:
        """Add a position fix: stamp [ns], latitude, longitude [rad] and height [m], (3,)."""
        if not len(self._fix_ns) or t_ns > self._fix_ns[-1]:
            self._fix_ns = np.concatenate((self._fix_ns[1 - MAX_FIXES :], (t_ns,)))
            self._fix_lla = np.concatenate((self._fix_lla[1 - MAX_FIXES :], (lla,)))

    def mean_force(self) -> Array | None:
        """Return the mean specific force (3,) over `WINDOW` [m/s²]; None: too short."""
        grid = self._grid
        if len(grid) < SHORTEST_WINDOW / STEP:
            return None
        begin = max(0, len(grid) - 1 - round(WINDOW / STEP))
        return np.asarray((grid[-1, 4:] - grid[begin, 4:]) / (STEP * (len(grid) - 1 - begin)))

    def long_motions(self) -> list[Motion]:
        """Return the motions of the last minute, once there is more than the shorter window."""
        is_longer = len(self._grid) > (WINDOW + SHORTEST_WINDOW) / STEP
        return self.motions(LONG_WINDOW, 1) if is_longer else []

    def motions(self, window: float, shortest: int) -> list[Motion]:
        """Return the motions of the last ``window`` seconds, from an index of ``INTERVALS`` on."""
        grid = self._grid[-round((window + 2.0) / STEP) :]
        if len(grid) < SHORTEST_WINDOW / STEP or len(self._fix_ns) < 3:
            return []
        fix_t, lla = (self._fix_ns - self._start_ns) * 1e-9, self._fix_lla
        reach = CLOCK_OFFSETS[-1]
        begin = max(grid[0, 0] + reach, grid[-1, 0] - window)
        inside = (fix_t > begin) & (fix_t < grid[-1, 0] - reach)
        fix_t, lla = fix_t[inside], lla[inside]
        if len(fix_t) < 3 or fix_t[-1] - fix_t[0] < SHORTEST_WINDOW - 2.0 * reach - 1.0:
            return []
        position_n = np.nan_to_num(displacement(lla[0], lla))
        steps = np.diff(grid[:, 1:], axis=0)
        motions = []
        for interval, least in list(zip(INTERVALS, LEAST_CHANGE, strict=True))[shortest:]:
            triples = triples_of(fix_t, interval)
            motion = Motion(grid[:, 0], steps[:, :3], steps[:, 3:], fix_t, position_n, triples)
            changes = np.sum(motion.change_n[:, :2] ** 2)
            if len(triples) >= FEWEST_CHANGES and changes > least**2 * len(triples):
                motions.append(motion)
        return motions
