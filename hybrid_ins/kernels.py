"""
All kernels compiled ahead of their first use, by other processes.

Compiling takes ten to sixty seconds, once for each version of the package; the machine code is kept
(`kernel_cache`). The node and the programs call `prepare` before their first sample;
``python -m hybrid_ins.kernels`` does it at the end of an installation.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence

import numpy as np

from hybrid_ins import kernel_cache
from hybrid_ins.core.filter import fix_update
from hybrid_ins.core.imu import fix_motion, standstill, straight_line
from hybrid_ins.core.imu import health as imu_health
from hybrid_ins.core.imu.samples import SAMPLE_DTYPE
from hybrid_ins.core.imu_axes import fit as imu_axes_fit
from hybrid_ins.core.inertial import propagation
from hybrid_ins.core.inertial.state import COVARIANCE, N_ERROR, N_NAV, NavState
from hybrid_ins.core.noise import (
    heading_information,
    hypotheses,
    multiple_model_update,
    scatter_evidence,
    slow_error,
)
from hybrid_ins.core.noise import multiple_model_step as noise_multiple_model_step
from hybrid_ins.core.sensor_errors import (
    clock_offset,
    clock_sensitivity,
    scale_errors,
    scale_sensitivity,
)
from hybrid_ins.core.sensor_errors import lever_arm as lever_arm_observer
from hybrid_ins.core.update import iterated_update, kalman, linalg, measurements
from hybrid_ins.noise_regressor import window
from hybrid_ins.ros.estimator import imu_admission
from hybrid_ins.ros.output import odom_frame, output

COMPILING = "compiling the filter for this machine, once: 10 to 60 s"
WAITING = "another process compiles the filter for this machine; waiting for it: up to 60 s"
NODE = FILTER, OUTPUT = "filter", "output"
"""Parts that the node and every program need."""
OFFLINE = SMOOTHING, CALIBRATION = "smoothing", "calibration"
"""Parts that some programs need besides."""


def prepare(announce: Callable[[str], None] = lambda text: None, parts: Sequence[str] = ()) -> None:
    """
    Load every kernel, after compiling it where that has not been done.

    Of several processes that need it, one compiles and the others wait. All of them may be ended
    by a signal at any time; what was compiled until then is kept.

    Parameters
    ----------
    announce : callable
        Given a line for the user before anything that takes long.
    parts : sequence of str
        Of `OFFLINE`: compiled, too, where that has not been done.
    """
    _skip_scipy()
    is_kept = kernel_cache.enable() is not None
    if _missing((*NODE, *parts)):
        with kernel_cache.exclusive(lambda: announce(WAITING)):
            if _missing((*NODE, *parts)):
                announce(COMPILING)
                if is_kept:
                    _compile_in_children(NODE)
                    _compile_in_children(parts)
    for part in NODE:
        _COMPILE[part]()


def is_compiled() -> bool:
    """Return whether `prepare` has nothing to compile for the node."""
    return not _missing(NODE)


def _missing(parts: Sequence[str]) -> list[str]:
    return [part for part in parts if not kernel_cache.is_complete(part)]


def _compile_in_children(parts: Sequence[str]) -> None:
    """
    Compile what is missing, each part in a process of its own.

    A signal's handler ends this wait by an exception; raised within the compiler, the exception
    would be lost in its callbacks from C, or be printed by an object that it left half made.
    """
    children = {part: _start_compilation(part) for part in _missing(parts)}
    try:
        for part, child in children.items():
            if child.wait() == 0:
                kernel_cache.mark_complete(part)
    finally:
        for child in children.values():
            child.kill()
            child.wait()


def _start_compilation(part: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-m", "hybrid_ins.kernels", part],
        stdin=subprocess.PIPE,  # closed when this process ends, see `_end_with_parent`
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


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
    numbers, integers = np.zeros((1, 7)), np.ones((1, 7), np.int64)
    propagation.run_samples(nav, 0, numbers, integers, 1, 0.0, np.empty((1, N_NAV)))
    z, H = measurements.position_model(nav, np.zeros(3), np.zeros(3))
    kalman.innovation(nav, z, H, np.eye(3))
    kalman.linear_update(nav, z, H, np.eye(3))
    iterated_update.update(nav, z, H, np.eye(3))
    iterated_update.linearisation(nav[COVARIANCE], z, H, np.eye(3))
    kalman.inject(nav, np.zeros(N_ERROR))
    linalg.log_determinant(np.eye(3))
    heading_information.heading_information(nav[COVARIANCE], H, np.eye(3), np.eye(3))
    heading_information.follow_heading(np.zeros(4), 0.0, 0.0, 0.0, 1.0, 1.0)
    scatter_evidence.scatter_evidence(nav[COVARIANCE], z, H, np.eye(3), np.eye(3))
    measurements.scaled_by_axis(np.eye(3), 1.0, 1.0)
    slow_error.slow_part(np.eye(3), 1.0, 1.0, 0.0, 0.0, 0.0, np.empty(0), 0.0)
    slow_error.change_slow_error(nav, np.zeros(3), 0.0, slow_error.NO_GROWTH)
    clock = clock_offset.ClockOffsetObserver(0.1).values
    fix_update.fuse_ordinary_fix(
        nav,
        np.zeros(3),
        np.zeros(3),
        np.eye(3),
        True,
        np.zeros(3),
        0.0,
        slow_error.NO_GROWTH,
        False,
        1.0,
        0.0,
        clock,
        0.0,
        heading_information.HeadingInformation().values,
        0.0,
        0.0,
        np.empty(0),
        np.zeros(fix_update.N_RESULT),
    )


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
    values = np.ones(multiple_model_update.WEIGHTS.stop)
    estimates = np.zeros((noise_multiple_model_step.N_ROWS, hypotheses.WIDTH))
    multiple_model_update.update_hypotheses(
        hypotheses.WIDE_HYPOTHESES,
        estimates,
        estimates.copy(),
        values,
        0.1,
        nav,
        np.ones(12),
        H,
        turn,
        1.0,
        0.0,
        turn,
        np.zeros(hypotheses.WIDTH),
        np.ones((3, hypotheses.WIDTH)),
        np.ones(3),
        zero,
        (0.0, 0.0),
        np.zeros(N_ERROR),
        z,
        H,
        np.zeros(N_ERROR),
        np.eye(N_ERROR),
        True,
    )
    clock = np.ones(clock_offset.N_CLOCK)
    h, gain = clock_sensitivity.sensitivities(nav, H)[0], np.zeros((N_ERROR, 3))
    clock_sensitivity.correct_sensitivities(nav, H, gain, h, np.zeros(N_ERROR), True)
    clock_sensitivity.noise_information(nav, H, gain, turn, True)
    clock_offset.observe(clock, 0.0, zero, h, turn, 0.0, True)
    lever_arm_observer.observe_lever_arm(
        np.ones(lever_arm_observer.N_VALUES),
        0.1,
        nav,
        nav,
        zero,
        H,
        gain,
        turn,
        1.0,
        True,
        True,
    )
    lever_arm_observer.dependence_on_lever_arm(nav, H)
    n = scale_errors.N_PARAMETERS
    scale_errors.observe_scale_errors(
        np.zeros(n), np.eye(n), 1.0, nav[COVARIANCE], zero, H, np.zeros((3, n)), turn, 1.0
    )
    sensitivity = np.zeros((N_ERROR, scale_errors.N_LEVER + scale_sensitivity.N_SCALE))
    scale_errors.attitude_mean_square(sensitivity, np.zeros(n), np.eye(n), np.zeros(6))
    scale_sensitivity.follow_samples(
        nav,
        np.ones(1),
        np.zeros((1, 6)),
        np.zeros(6),
        sensitivity,
        np.zeros((N_ERROR, scale_sensitivity.N_SCALE)),
    )
    line = straight_line.no_line()
    imu_admission.judge(1, (0.0, 0.0, 9.8), (0.0, 0.0, 0.0), 100.0, 10.0, *line)
    stamps, vectors = np.arange(1, 3), np.ones((2, 3))
    imu_admission.end_of_stretch(stamps, vectors, vectors, 0, 0, 1, 2, 100.0, 10.0, *line)
    samples = np.zeros(20, SAMPLE_DTYPE)
    imu_health.find_fault(samples)
    standstill.is_standing(samples)
    fix_motion.significant_speed(np.arange(4), np.zeros((4, 3)))
    imu_axes_fit.integrate_force(
        np.zeros((1, 1, 3)), np.zeros((1, 3)), np.zeros((1, 2, 3)), np.zeros((3, 2, 3))
    )
    triples, changes = np.zeros((1, 3), np.intp), np.zeros((1, 1, 1, 3))
    imu_axes_fit.change_on_paths(
        np.zeros((1, 2, 3)), 0.0, np.arange(3.0), np.zeros(1), triples, changes
    )
    turns = np.zeros((1, 3, 3))
    imu_axes_fit.add_products(np.zeros((1, 3)), changes[0], turns)
    imu_axes_fit.subtract_turned(np.zeros((1, 3)), turns, changes[0], changes[0].copy())
    readings = window.own_axes(np.zeros((20, 7)), turn)
    window.find_fault(np.arange(20), readings, (1e7, 1e9))
    window.quantisation_step(readings)


def _compile_smoothing() -> None:
    from hybrid_ins.core.smoothing.segments import SmootherStart, Update
    from hybrid_ins.core.smoothing.smoother import Smoother

    samples = np.zeros(40, SAMPLE_DTYPE)
    samples["t_ns"] = np.arange(40) * 10_000_000
    samples["f"][:, 2] = -9.8
    start = SmootherStart(100_000_000, np.zeros(6), NavState.from_flat(_some_state()), np.ones(12))
    fix = measurements.PositionFix(205_000_000, start.state.lla, np.eye(3), np.zeros(3))
    updates = [Update(fix.t_ns, start.psd, fix, 1.0)]
    smoother = Smoother(start, samples, updates, 0.01, 100_000_000, {}, {})
    smoother.run()
    assert sum(len(stamps) for stamps, _ in smoother.states()) > 0


def _compile_calibration() -> None:
    from hybrid_ins.calibration.innovations import N_SAID, innovations

    empty = np.empty((0, 3))
    innovations(
        _some_state(),
        np.zeros(1),
        np.zeros((1, 6)),
        np.ones((1, 2)),
        np.empty(0),
        np.empty(0, np.int64),
        empty,
        np.empty((0, 3, 3)),
        empty,
        np.zeros(3),
        0.0,
        0.0,
        empty,
        np.empty((0, 3, 3)),
        np.empty(0),
        np.empty((0, N_NAV)),
        np.empty((0, N_SAID)),
    )


_COMPILE = {
    FILTER: _compile_filter,
    OUTPUT: _compile_output,
    SMOOTHING: _compile_smoothing,
    CALIBRATION: _compile_calibration,
}


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
    """Compile all kernels, or (as a child of `prepare`) those of the parts that are named."""
    words = list(sys.argv[1:] if argv is None else argv)
    if words:
        _end_with_parent()
        kernel_cache.enable()
        for part in words:
            _COMPILE[part]()
    else:
        prepare(print, OFFLINE)
    return 0


if __name__ == "__main__":
    sys.exit(main())
