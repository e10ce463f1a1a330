"""
Endurance: a day of driving, standing or flying, and whether what the filter says of itself holds.

Beside the state, the filter propagates the clock offset of fixes and the noise hypotheses for as
long as it runs. Over simulated hours with exact truth this checks that the clock offset stays
within three standard deviations of the true one, that position errors fit their covariance, and
that no number grows or shrinks without bound::

    python -m tools.robustness.endurance --hours 24 --seeds 3
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import yaml
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import make_interp_spline

from hybrid_ins import parameters
from hybrid_ins.bags.messages import new_message
from hybrid_ins.cli import options, program
from hybrid_ins.core.filter.ins_filter import InsFilter
from hybrid_ins.core.inertial.earth import curvature_scale
from hybrid_ins.core.inertial.state import DP, LLA, PLACES, SENSITIVITY, covariance
from hybrid_ins.core.noise.multiple_model_step import OFFSETS
from hybrid_ins.ros.estimator import estimator as ros_estimator
from hybrid_ins.ros.estimator.estimator import Estimator
from hybrid_ins.ros.estimator.imu_block import handle_imu_block
from hybrid_ins.ros.messages import conversions
from hybrid_ins.ros.messages.conversions import FLIP
from hybrid_ins.simulation.motions import (
    START_LLA,
    Motion,
    aircraft_flight,
    car_drive,
    quadrotor_flight,
)
from hybrid_ins.simulation.sensors import ImuErrors, corrupt, fixes, sample
from tools.parallel import add_jobs, run_parallel
from tools.robustness.held_numbers import growing, held_numbers

Array = NDArray[np.float64]

RATE = 100.0  # Hz, of the IMU
IMU_STD = np.repeat([0.05, 0.003], 3)  # m/s², rad/s, per sample
BIAS = np.repeat([0.03, 0.002], 3)
FIX_STD = np.array([3.0, 3.0, 6.0])  # m, NED: an ordinary receiver
CHUNK = 300.0  # s, of samples simulated at once
AUDIT = 3600.0  # s, between two audits of every number that the estimator holds: whole chunks
EVERY = 10  # fixes
T0_NS = 10**9
GRID = 0.1  # s, between the knots of a drive


def smooth_drive(duration: float, seed: int) -> Motion:
    """Speed up in 10 s to 6 m/s every 70 s, hold, brake for 20 s, stand; weave gently."""
    return _drive(duration, seed, lambda t: _stopping_speed(t, 30.0))


def stop_and_go(duration: float, seed: int) -> Motion:
    """Hold for 10 s only, and stand for 30 s: most corrections are zero-velocity updates."""
    return _drive(duration, seed, lambda t: _stopping_speed(t, 10.0))


def _stopping_speed(t: Array, hold: float) -> Array:
    return 6.0 * np.interp(t % 70.0, (0.0, 10.0, 10.0 + hold, 30.0 + hold), (0.0, 1.0, 1.0, 0.0))


def cruise(duration: float, seed: int) -> Motion:
    """Drive on at 20 m/s; weave gently."""
    return _drive(duration, seed, lambda t: np.full_like(t, 20.0))


def stand(duration: float, seed: int) -> Motion:
    """Stand still."""
    return _drive(duration, seed, np.zeros_like)


def _drive(duration: float, seed: int, speed: Callable[[Array], Array]) -> Motion:
    """On a level road with gentle bends: the yaw rate is 0.004 sin(2 π t / 23) rad/s at 6 m/s."""
    t = np.arange(0.0, duration + GRID, GRID)
    forward = speed(t)
    yaw_rate = 0.004 * np.sin(2.0 * np.pi * t / 23.0) * np.minimum(forward / 6.0, 1.0)
    yaw = 0.5 * seed + GRID * np.cumsum(yaw_rate)
    velocity_n = forward[:, None] * np.stack((np.cos(yaw), np.sin(yaw), 0.0 * t), axis=1)
    return Motion(
        START_LLA,
        duration,
        make_interp_spline(t, velocity_n, k=5).antiderivative(),
        make_interp_spline(t, np.stack((0.0 * t, 0.0 * t, yaw), axis=1), k=5),
    )


MOTIONS: dict[str, Callable[[float, int], Motion]] = {
    "smooth drive": smooth_drive,
    "stop and go": stop_and_go,
    "standing": stand,
    "cruise": cruise,
    "car": car_drive,
    "quadrotor": quadrotor_flight,
    "aircraft": aircraft_flight,
}


@dataclass(frozen=True)
class Day:
    """What a filter estimated beside its state, at every ``EVERY``-th fix."""

    t: Array  # (K,) s
    clock_error: Array  # (K,) s, estimated minus true offset
    clock_sigma: Array  # (K,) s
    position_nees: Array  # (K,) 3 on average
    factors: Array  # (K, 3) on accelerometer, gyroscope, fixes
    sensitivity: Array  # (K,) of the state to the clock offset, largest element
    state_offset: Array  # (K,) of a noise hypothesis, largest over its standard deviation
    eigenvalue: Array  # (K,) of a noise hypothesis' correlation matrix, smallest
    audit_t: Array  # (A,) s, every ``AUDIT`` seconds
    held: dict[str, Array]  # (A,) largest magnitude that the estimator holds, by place
    not_finite: tuple[str, ...]  # places with a number that is not finite at the end
    summary: str  # what was fused and what not
    failure: str  # why it ended early

    @property
    def clock_excess(self) -> float:
        """Largest error of the clock offset over its standard deviation."""
        return float(np.max(np.abs(self.clock_error) / self.clock_sigma))

    def what_is_held(self) -> str:
        """Return how many numbers' places there are, what is not finite, and what grows."""
        grown = growing(self.audit_t, self.held)
        parts = [f"{place} {a:.3g} to {b:.3g}" for place, (a, b) in sorted(grown.items())]
        return f"{len(self.held)}, {', '.join(self.not_finite)}, {', '.join(parts) or 'none'}"


def live(
    kind: str,
    duration: float,
    seed: int,
    offset: float,
    values: Mapping[str, object],
    rate: float = RATE,
    period: float = 1.0,
) -> Day:
    """
    Run the node's estimator over a day; ``offset`` [s] is missing from the stamps of fixes.

    An IMU of another ``rate`` [Hz] has noise of the same density; ``period`` [s] is that of fixes.
    """
    rng = np.random.default_rng(seed)
    motion = MOTIONS[kind](duration + 1.0, seed)
    sign = rng.choice([-1.0, 1.0], 6)
    errors = ImuErrors(
        accelerometer_std=IMU_STD[:3] * np.sqrt(rate / RATE),
        gyroscope_std=IMU_STD[3:] * np.sqrt(rate / RATE),
        accelerometer_bias=(BIAS * sign)[:3],
        gyroscope_bias=(BIAS * sign)[3:],
    )
    given = {
        "alignment.heading_source": "parameter",
        "alignment.yaw": float(conversions.yaw_ned_from_enu(motion.rpy(0.0)[2])),
        "alignment.yaw_std": 0.05,
    }
    estimator = Estimator(parameters.check_all(given | dict(values)), lambda level, text: None)
    fix = new_message("sensor_msgs/msg/NavSatFix")
    fix.position_covariance = np.diag(FIX_STD[[1, 0, 2]] ** 2).ravel()
    fix.position_covariance_type = 2
    rows: list[tuple[float, ...]] = []
    audits: list[tuple[float, dict[str, tuple[float, float, bool]]]] = []
    failure = ""
    for begin in np.arange(0.0, duration, CHUNK):
        chunk = min(CHUNK, duration - begin)
        t = begin + np.arange(round(chunk * rate)) / rate
        imu = corrupt(sample(motion, t), errors, rng)
        errors = replace(
            errors,
            accelerometer_bias=imu.accelerometer_bias[-1],
            gyroscope_bias=imu.gyroscope_bias[-1],
        )
        stamps, force, turn = _stamps(t), imu.specific_force @ FLIP, imu.angular_rate @ FLIP
        gnss = fixes(sample(motion, begin + np.arange(0.5, chunk, period)), rng, FIX_STD)
        start = 0
        try:
            for k in range(len(gnss.t)):
                stop = int(np.searchsorted(stamps, _stamps(gnss.t[k]), side="right"))
                handle_imu_block(estimator, stamps[start:stop], force[start:stop], turn[start:stop])
                start = stop
                stamp = int(_stamps(gnss.t[k] - offset))
                conversions.set_stamp(fix.header.stamp, stamp)
                fix.latitude, fix.longitude = np.degrees(gnss.lla[k, :2]).tolist()
                fix.altitude = float(gnss.lla[k, 2])
                estimator.handle_fix(fix)
                estimator.pop_reports()
                running = estimator.navigator.filter
                hypotheses = None if running is None else running.noise.factors.estimates
                if k % EVERY == 0 and hypotheses is not None:
                    lla = sample(motion, [(running.t_ns - T0_NS) * 1e-9]).lla[0]
                    missing = offset - estimator.clock.offset
                    rows.append((gnss.t[k], *look(running, lla, missing)))
        except (ValueError, ZeroDivisionError) as error:
            failure = f"{error} at {gnss.t[k]:.0f} s"
            break
        handle_imu_block(estimator, stamps[start:], force[start:], turn[start:])
        if begin % AUDIT == 0.0:
            audits.append((begin + chunk, held_numbers(estimator)))
    columns = np.array(rows).T
    places = sorted(set().union(*(found for _, found in audits)))
    held = {
        place: np.array(
            [max(map(abs, found.get(place, (0.0, 0.0, True))[:2])) for _, found in audits]
        )
        for place in places
    }
    return Day(
        *columns[:4],
        columns[4:7].T,
        *columns[7:],
        np.array([t for t, _ in audits]),
        held,
        tuple(place for place, ends in audits[-1][1].items() if not ends[2]),
        estimator.status.summary(),
        failure,
    )


def look(running: InsFilter, lla: Array, missing: float) -> tuple[float, ...]:
    """Return a row of `Day` without its time; the true position, and clock offset still missing."""
    off = (lla - running.nav[LLA]) * curvature_scale(lla)
    factors = running.noise.factors
    assert factors is not None and factors.estimates is not None
    P = factors.estimates[:OFFSETS][PLACES]  # (15, 15, hypotheses)
    std = np.sqrt(np.diagonal(P)).T  # (15, hypotheses)
    correlation = P.transpose(2, 0, 1) / (std.T[:, :, None] * std.T[:, None, :])
    s = running.nav[SENSITIVITY]
    return (
        running.clock.residual - missing,
        running.clock.sigma,
        float(off @ np.linalg.solve(covariance(running.nav)[DP, DP], off)),
        *running.noise.imu_factors,
        running.noise.found.fixes,
        float(np.abs(s).max()),
        float(np.max(np.abs(factors.estimates[OFFSETS:]) / std)),
        float(np.linalg.eigvalsh(correlation).min()),
    )


def _stamps(t: ArrayLike) -> NDArray[np.int64]:
    return np.rint(np.asarray(t) * 1e9).astype(np.int64) + T0_NS


def main(argv: Sequence[str] | None = None) -> int:
    """Run the days, and print a line for each; fail where one fails."""
    parser = program.parser("endurance", __doc__ or "")
    parser.add_argument("--hours", type=options.positive, default=24.0)
    parser.add_argument("--seeds", type=options.positive_count, default=3)
    parser.add_argument(
        "--offset", type=options.number, default=0.0, help="of the fixes' clock [s]"
    )
    parser.add_argument("--motion", nargs="+", choices=MOTIONS, default=list(MOTIONS))
    parser.add_argument("--estimate", action="store_true", help="correct the clock offset")
    parser.add_argument("--param", nargs=2, action="append", default=[], metavar=("NAME", "VALUE"))
    parser.add_argument("--imu-rate", type=options.positive, default=RATE, help="[Hz]")
    parser.add_argument("--fix-period", type=options.positive, default=1.0, help="[s]")
    parser.add_argument(
        "--report-period", type=options.positive, default=0.1, help="of the node [s]"
    )
    add_jobs(parser, 1)
    return program.run(_body, parser.parse_args(argv))


def _body(args: argparse.Namespace) -> int:
    ros_estimator.REPORT_NS = round(args.report_period * 1e9)
    values: dict[str, object] = {"gnss.time_offset.estimate": args.estimate}
    values |= {name: yaml.safe_load(value) for name, value in args.param}
    parameters.check_all(values)
    todo = [
        (kind, args.hours * 3600.0, seed, args.offset, values, args.imu_rate, args.fix_period)
        for kind in args.motion
        for seed in range(args.seeds)
    ]
    print(
        "motion, seed: hours; clock offset: largest error/sigma, error, sigma at the end, least, "
        "largest [ms]; largest sensitivity; mean position NEES; factors: smallest, median, "
        "largest; hypotheses: "
        "largest offset/sigma, least eigenvalue; places of numbers held, not finite, growing "
        "(from the second to the last quarter of the time); fixes; failure"
    )
    failed = False
    for (kind, _, seed, *_), day in zip(todo, run_parallel(live, todo, args.jobs), strict=True):
        failed |= bool(day.failure) or day.clock_excess > 3.0
        print(
            f"{kind}, {seed}: {day.t[-1] / 3600:.2f}; "
            f"{day.clock_excess:.2g}, {1e3 * day.clock_error[-1]:.1f}, "
            f"{1e3 * day.clock_sigma[-1]:.1f}, {1e3 * day.clock_sigma.min():.2g}, "
            f"{1e3 * day.clock_sigma.max():.3g}; "
            f"{day.sensitivity.max():.2g}; {day.position_nees[3:].mean():.2f}; "
            f"{day.factors.min(axis=0).round(3)}, {np.median(day.factors, axis=0).round(2)}, "
            f"{day.factors.max(axis=0).round(1)}; "
            f"{day.state_offset.max():.2g}, {day.eigenvalue.min():.2g}; "
            f"{day.what_is_held()}; "
            f"{day.summary}; {day.failure or 'none'}",
            flush=True,
        )
    return int(failed)


if __name__ == "__main__":
    raise SystemExit(main())
