"""
All kernels compiled ahead of their first use, by two processes.

Compiling takes ten to sixty seconds, once for each version of the package; the machine code is kept
(`kernel_cache`). Programs call `prepare` before their first sample, the node before `rclpy.init`,
which would take over the signals; ``python -m hybrid_ins.kernels`` does it at the end of an
installation.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from hybrid_ins import kernel_cache
from hybrid_ins.core import (
    clock_offset,
    fix_update,
    imu_axes_fit,
    imu_health,
    iterated_update,
    kalman,
    linalg,
    measurements,
    noise_multiple_model_step,
    propagation,
    standstill,
)
from hybrid_ins.core.samples import SAMPLE_DTYPE
from hybrid_ins.core.state import COVARIANCE, N_ERROR, N_NAV, NavState
from hybrid_ins.noise_regressor import window
from hybrid_ins.ros import imu_admission, odom_frame, output

COMPILING = "compiling the filter for this machine, once: 10 to 60 s"
WAITING = "another process compiles the filter for this machine; waiting for it: up to 60 s"
FILTER, CALIBRATION = "filter", "calibration"


def prepare(
    announce: Callable[[str], None] = lambda text: None, *, calibration: bool = False
) -> None:
    """
    Load every kernel, after compiling it where that has not been done.

    Of several processes that need it, one compiles and the others wait. All of them may be ended
    by a signal at any time; what was compiled until then is kept.

    Parameters
    ----------
    announce : callable
        Given a line for the user before anything that takes long.
    calibration : bool
        The kernels of `hybrid_ins.calibration`, too.
    """
    _skip_scipy()
    kernel_cache.enable()
    parts = (FILTER, CALIBRATION) if calibration else (FILTER,)
    if not all(map(kernel_cache.is_complete, parts)):
        with kernel_cache.exclusive(lambda: announce(WAITING)):
            if not all(map(kernel_cache.is_complete, parts)):
                announce(COMPILING)
                with _filter_compiled_beside():
                    _compile_output()
                _compile_filter()
                kernel_cache.mark_complete(FILTER)
                if calibration:
                    _compile_calibration()
                    kernel_cache.mark_complete(CALIBRATION)
                return
    _compile_filter()
    _compile_output()


def is_compiled() -> bool:
    """Return whether `prepare` has nothing to compile for the node."""
    return kernel_cache.is_complete(FILTER)


@contextmanager
def _filter_compiled_beside() -> Iterator[None]:
    """Within the block, another process compiles the filter; it does not outlive this one."""
    if kernel_cache.enable() is None:
        yield
        return
    child = subprocess.Popen(
        [sys.executable, "-m", "hybrid_ins.kernels", FILTER],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        yield
        child.wait()
    finally:
        child.kill()
        child.wait()


def _end_with_parent() -> None:
    """End this process when the one that holds the other end of its standard input does."""

    def watch() -> None:
        while os.read(0, 1024):
            pass
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _skip_scipy() -> None:
    """
    Keep numba from loading SciPy's linear algebra.

    Numba imports it when it starts, in case that a kernel multiplies matrices. Ours do not, and
    the import alone costs 0.3 s of the start and 40 MB.
    """
    name = "scipy.linalg.cython_blas"
    if name in sys.modules:
        return
    sys.modules[name] = None  # type: ignore[assignment]
    try:
        import numba.np.arraymath  # noqa: F401
    finally:
        del sys.modules[name]


def _compile_filter() -> None:
    nav = _some_state()
    propagation.step(nav, 0.01, 0.0, 0.0, -9.8, 0.0, 0.0, 0.0, 0.0)
    propagation.propagate_covariance(nav)
    readings = np.zeros((1, 6))
    propagation.run(nav, np.full(1, 0.01), readings, 0.0, np.empty((1, N_NAV)))
    z, H = measurements.position_model(nav, np.zeros(3), np.zeros(3))
    kalman.innovation(nav, z, H, np.eye(3))
    iterated_update.update(nav, z, H, np.eye(3))
    iterated_update.linearisation(nav[COVARIANCE], z, H, np.eye(3))
    kalman.inject(nav, np.zeros(N_ERROR))
    linalg.log_determinant(np.eye(3))
    clock = clock_offset.ClockOffsetObserver(0.1).values
    fix_update.fuse_ordinary_fix(nav, z, H, np.eye(3), True, clock, 0.0, 0.0)


def _compile_output() -> None:
    nav, zero, turn = _some_state(), np.zeros(3), np.eye(3)
    odometry, local = np.zeros(output.N_ODOMETRY), np.zeros(output.N_ODOMETRY)
    state = odom_frame.start()
    output.odometry_values(nav, zero, turn, zero, zero, odometry)
    odom_frame.advance(state, 0.01, odometry, local)
    output.odometry_block(nav[None, :N_NAV].copy(), zero, turn, zero, zero, odometry[None])
    odom_frame.advance_block(state, np.zeros(1), odometry[None], local[None])
    output.fix_values(nav, zero, np.zeros(output.N_FIX))
    output.bias_values(nav, np.zeros(output.N_BIAS))
    z, H = measurements.velocity_model(nav, zero, zero)
    noise_multiple_model_step.mean_system(nav, zero, turn, 0.1)
    noise_multiple_model_step.advance(
        nav[COVARIANCE][:, None].copy(),
        np.zeros((N_ERROR, 1)),
        np.zeros((N_ERROR, N_ERROR)),
        0.1,
        turn,
        np.ones(12),
        np.ones((3, 1)),
        z,
        H,
        np.eye(3),
        np.zeros(N_ERROR),
        6.0,
    )
    clock = np.ones(clock_offset.N_CLOCK)
    clock_offset.sensitivities(nav, clock, 0.0, H)
    clock_offset.observe(clock, 0.0, zero, nav[:N_ERROR], zero, zero, turn, True)
    imu_admission.is_usable(1, 0.0, 0.0, 9.8, 0.0, 0.0, 0.0, 100.0, 10.0)
    stamps, vectors = np.arange(1, 3), np.ones((2, 3))
    imu_admission.end_of_stretch(stamps, vectors, vectors, 0, 0, 1, 2, 100.0, 10.0)
    samples = np.zeros(20, SAMPLE_DTYPE)
    imu_health.find_fault(samples)
    standstill.is_standing(samples)
    imu_axes_fit.integrate_force(
        np.zeros((1, 1, 3)), np.zeros((1, 3)), np.zeros((1, 2, 3)), np.zeros((3, 2, 3))
    )
    readings = window.own_axes(np.zeros((20, 7)), turn)
    window.find_fault(np.arange(20), readings, (1e7, 1e9))
    window.quantisation_step(readings)


def _compile_calibration() -> None:
    from hybrid_ins.calibration.innovations import innovations

    empty = np.empty((0, 3))
    innovations(
        _some_state(),
        np.zeros(1),
        np.zeros((1, 6)),
        np.empty(0),
        np.empty(0, np.int64),
        empty,
        np.empty((0, 3, 3)),
        np.zeros(3),
        0.0,
        0.0,
        empty,
        np.empty((0, 3, 3)),
        np.empty(0),
        np.empty((0, N_NAV)),
    )


def _some_state() -> np.ndarray:
    return NavState(
        np.array([0.5, 0.0, 0.0]),
        np.zeros(3),
        np.array([0.0, 0.0, 0.0, 1.0]),
        np.zeros(3),
        np.zeros(3),
        np.eye(N_ERROR),
    ).to_flat()


def main(argv: Sequence[str] | None = None) -> int:
    """Compile all kernels, or (as a child of `prepare`) those of the filter proper."""
    words = list(sys.argv[1:] if argv is None else argv)
    if words == [FILTER]:
        _end_with_parent()
        kernel_cache.enable()
        _compile_filter()
    else:
        prepare(print, calibration=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
