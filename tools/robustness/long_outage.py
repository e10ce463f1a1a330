"""
Hours without a fix: the estimator's covariance has to stay finite, and its memory flat.

A simulated drive aligns the estimator; then only its IMU samples come, again and again. The memory
of this process is read from the kernel.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence

import numpy as np

from hybrid_ins import kernels, parameters
from hybrid_ins.bags.messages import new_message
from hybrid_ins.cli import options, program
from hybrid_ins.core.inertial.state import covariance
from hybrid_ins.ros.estimator.estimator import Estimator
from hybrid_ins.ros.estimator.imu_block import handle_imu_block
from hybrid_ins.ros.messages import conversions
from hybrid_ins.ros.messages.conversions import FLIP
from hybrid_ins.ros.messages.type_names import FIX
from hybrid_ins.simulation.motions import car_drive
from hybrid_ins.simulation.sensors import ImuErrors, corrupt, fixes, sample
from tools.robustness.soak import GROWTH, SETTLED, resident

EPOCH_NS = 1_700_000_000_000_000_000
ALIGNING, RATE = 60, 100  # s with fixes; Hz of the IMU
FIX_STD = np.array([0.1, 0.1, 0.2])  # m, north, east, down


def main(argv: Sequence[str] | None = None) -> int:
    """Run it."""
    parser = program.parser("long_outage", __doc__ or "")
    parser.add_argument(
        "--hours", type=options.positive, default=2.0, metavar="H", help="[%(default)s]"
    )
    return program.run(_body, parser.parse_args(argv))


def _body(args: argparse.Namespace) -> int:
    kernels.prepare(print)
    rng = np.random.default_rng(0)
    motion = car_drive(ALIGNING + 1.0, 0)
    t = np.arange(ALIGNING * RATE) / RATE
    noise = ImuErrors(accelerometer_std=np.full(3, 0.02), gyroscope_std=np.full(3, 0.002))
    imu = corrupt(sample(motion, t), noise, rng)
    force, rate = imu.specific_force @ FLIP, imu.angular_rate @ FLIP
    gnss = fixes(sample(motion, 0.5 + np.arange(ALIGNING)), rng, FIX_STD)
    estimator = Estimator(
        parameters.check_all(
            {
                "alignment.heading_source": "parameter",
                "alignment.yaw": float(conversions.yaw_ned_from_enu(motion.rpy(0.0)[2])),
            }
        ),
        lambda level, text: print(f"{level}: {text}"),
    )
    message = new_message(FIX)
    message.position_covariance = np.diag(FIX_STD[[1, 0, 2]] ** 2).ravel()
    message.position_covariance_type = 2
    memory, smallest, restarts = [], np.inf, 0
    for second in range(round(3600 * args.hours)):
        part = slice(second % ALIGNING * RATE, (second % ALIGNING + 1) * RATE)
        stamps = EPOCH_NS + second * 10**9 + np.arange(RATE) * (10**9 // RATE)
        handle_imu_block(estimator, stamps, force[part], rate[part])
        if second < ALIGNING:
            conversions.set_stamp(message.header.stamp, int(stamps[RATE // 2]))
            message.latitude, message.longitude = np.degrees(gnss.lla[second, :2]).tolist()
            message.altitude = float(gnss.lla[second, 2])
            estimator.handle_fix(message)
        estimator.pop_reports()
        if second >= ALIGNING and second % 60 == 0:
            running = estimator.navigator.filter
            if running is None:
                restarts += 1
                continue
            P = covariance(running.nav)
            scale = np.sqrt(np.diag(P))
            smallest = min(smallest, float(np.linalg.eigvalsh(P / np.outer(scale, scale))[0]))
            memory.append(resident(os.getpid()))
            finite = bool(np.all(np.isfinite(running.nav)))
            if not finite or not smallest > 0.0:
                print(f"after {second} s: finite {finite}, smallest eigenvalue {smallest:.2g}")
                return 1
    settled = memory[int(SETTLED * len(memory)) :]
    sigma = float(np.sqrt(np.max(np.diag(P)[:2]))) / 1000.0
    first, last, most = settled[0], settled[-1], max(settled)
    print(
        f"{args.hours:g} h without a fix at {RATE} Hz: state and covariance finite every minute, "
        f"{restarts} restarts\n"
        f"smallest eigenvalue of the correlations {smallest:.2g}, position sigma {sigma:.0f} km\n"
        f"memory {first:.1f} MB after a tenth, {last:.1f} MB at the end, {most:.1f} MB at most"
    )
    return int(restarts > 0 or settled[-1] > (1.0 + GROWTH) * settled[0])


if __name__ == "__main__":
    raise SystemExit(main())
