"""
All kernels compiled ahead of their first use, by two processes.

Compiling takes ten seconds of one processor, once for each version of the package; the machine
code is kept (`core.compilation`). Programs call `prepare` before their first sample;
``python -m hybrid_ins.kernels`` does it at the end of an installation.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Sequence

import numpy as np

from hybrid_ins.core import (
    clock_offset,
    compilation,
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
from hybrid_ins.ros import imu_input, odom_frame, output

NOTICE = "compiling the filter for this machine, once: 10 to 60 s"


def prepare(tell: Callable[[str], None] = lambda text: None) -> None:
    """
    Load every kernel, after compiling it where that has not been done.

    Parameters
    ----------
    tell : callable
        Given a line for the user when it will take a while.
    """
    compilation.spare_blas()
    if compilation.is_compiled():
        _compile_filter()
        _compile_output()
        return
    tell(NOTICE)
    other = None
    if compilation.CACHE is not None:
        other = subprocess.Popen(
            [sys.executable, "-m", "hybrid_ins.kernels", "filter"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
    try:
        _compile_output()
        if other is not None:
            other.wait()
    finally:
        if other is not None:
            other.kill()
            other.wait()
    _compile_filter()
    compilation.mark_compiled()


def _compile_filter() -> None:
    nav = _some_state()
    propagation.step(nav, 0.01, 0.0, 0.0, -9.8, 0.0, 0.0, 0.0, 0.0)
    propagation.propagate_covariance(nav)
    readings = np.zeros((1, 6))
    propagation.run(nav, np.full(1, 0.01), readings, 0.0, np.empty((1, N_NAV)))
    z, H = measurements.position_model(nav, np.zeros(3), np.zeros(3))
    kalman.innovation(nav, z, H, np.eye(3))
    iterated_update.update(nav, z, H, np.eye(3))
    kalman.inject(nav, np.zeros(N_ERROR))
    linalg.log_determinant(np.eye(3))


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
    s, acceleration, _ = clock_offset.propagate_sensitivity(np.zeros(N_ERROR), nav, zero, turn, 0.1)
    clock_offset.regress(s, zero, acceleration, z, H, np.eye(3), H.T.copy(), 0.0)
    imu_input.is_usable(1, 0.0, 0.0, 9.8, 0.0, 0.0, 0.0, 100.0, 10.0)
    stamps, vectors = np.arange(1, 3), np.ones((2, 3))
    imu_input.end_of_stretch(stamps, vectors, vectors, 0, 0, 1, 2, 100.0, 10.0)
    samples = np.zeros(20, SAMPLE_DTYPE)
    imu_health.find_fault(samples)
    standstill.is_standing(samples)
    readings = window.own_axes(np.zeros((20, 7)), turn)
    window.find_fault(np.arange(20), readings, (1e7, 1e9))
    window.quantisation_step(readings)


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
    """Compile all kernels, or those of the filter proper."""
    words = list(sys.argv[1:] if argv is None else argv)
    if words == ["filter"]:
        _compile_filter()
    else:
        prepare(print)
    return 0


if __name__ == "__main__":
    sys.exit(main())
