"""
The filter by itself: this one and its peers fly the same simulated flight, side by side.

Every contender takes the same IMU samples and fixes from the same wrong start, and is scored
against the truth midway between fixes, so that speed stands beside accuracy.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hybrid_ins import parameters
from hybrid_ins.bags.messages import new_message
from hybrid_ins.core import propagation
from hybrid_ins.core.earth import curvature_scale, lla_to_ecef
from hybrid_ins.core.filter_noise import FilterNoise
from hybrid_ins.core.gate import Gate
from hybrid_ins.core.ins_filter import FilterSettings, InsFilter
from hybrid_ins.core.iterated_update import update
from hybrid_ins.core.measurements import PositionFix
from hybrid_ins.core.noise import ConstantNoise, ProcessNoise
from hybrid_ins.core.rotations import matrix_from_quat
from hybrid_ins.core.samples import ImuRing
from hybrid_ins.core.state import LAST_F, LAST_W, LLA, N_NAV, PSD, covariance
from hybrid_ins.noise_regressor.reader import NoiseReader
from hybrid_ins.ros.cdr import ImuDecoder, OdometryEncoder, StampedEncoder
from hybrid_ins.ros.conversions import set_stamp
from hybrid_ins.ros.estimator import Estimator
from tools.benchmark.careful_numpy import CarefulFilter
from tools.benchmark.table import Section, ratios
from tools.paper.montecarlo import Run, Scenario, draw

Array = NDArray[np.float64]

NO_ROWS = np.empty((0, N_NAV))
LEVER = np.zeros(3)
RATE, FIX_RATE = 200.0, 5.0  # Hz


def _clocks() -> float:
    """CPU time [s] that reading both clocks takes: as much as a short block."""
    spent = []
    for _ in range(1000):
        start = time.process_time()
        time.perf_counter()
        time.perf_counter()
        spent.append(time.process_time() - start)
    return float(np.median(spent))


CLOCKS = _clocks()


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
        propagation.run(self.nav, dt, readings, self._interval, NO_ROWS)

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


class Flights:
    """What a contender's flights gave: seconds per sample and per fix, wall and CPU, and errors."""

    def __init__(self, name: str, make: Callable[[Run], Contender], arrays: bool = False) -> None:
        self.name = name
        self.make = make
        self.arrays = arrays  # takes a block's samples as arrays
        self.step: list[float] = []
        self.step_cpu: list[float] = []
        self.update: list[float] = []
        self.rmse = self.nees = float("nan")

    def fly(self, run: Run, blocks: list[tuple[Any, Any, Any, Any]]) -> None:
        """Fly once; the errors are those of the last flight."""
        contender = self.make(run)
        stepping = stepping_cpu = updating = 0.0
        errors, nees = [], []
        samples = 0
        for (dt, values, dt_list, values_list), (kind, k) in zip(blocks, _order(run), strict=True):
            given = (dt, values) if self.arrays else (dt_list, values_list)
            cpu, wall = time.process_time(), time.perf_counter()
            contender.block(*given)
            stepping += time.perf_counter() - wall
            stepping_cpu += time.process_time() - cpu - CLOCKS
            samples += len(dt)
            if kind == "fix":
                wall = time.perf_counter()
                contender.fix(run.fixes[k])
                updating += time.perf_counter() - wall
            else:
                position = lla_to_ecef(contender.lla()) - lla_to_ecef(run.lla[k])
                errors.append(np.linalg.norm(position))
                P = contender.P()
                if P is not None:
                    away = (run.lla[k] - contender.lla()) * curvature_scale(run.lla[k])
                    nees.append(away @ np.linalg.solve(P[:3, :3], away))
        self.step.append(stepping / samples * 1e6)
        self.step_cpu.append(stepping_cpu / samples * 1e6)
        self.update.append(updating / len(run.fixes) * 1e6)
        self.rmse = float(np.sqrt(np.mean(np.square(errors))))
        self.nees = float(np.mean(nees)) if nees else float("nan")


def _order(run: Run) -> Iterator[tuple[str, int]]:
    """What comes after each block of samples: a fix or a look at the errors, in time order."""
    stamps = run.samples["t_ns"]
    events = [(fix.t_ns, 0, "fix", k) for k, fix in enumerate(run.fixes)]
    events += [(int(stamps[row]), 1, "score", k) for k, row in enumerate(run.scored)]
    return ((kind, k) for *_, kind, k in sorted(events))


def _blocks(run: Run) -> list[tuple[Any, Any, Any, Any]]:
    """Cut the samples at the fixes and looks, as arrays and as lists."""
    stamps = run.samples["t_ns"]
    readings = np.hstack((run.samples["f"], run.samples["w"]))
    dt = np.diff(stamps, prepend=stamps[0]) * 1e-9
    ends = sorted([fix.t_ns for fix in run.fixes] + stamps[run.scored].tolist())
    blocks, at = [], 1
    for end in ends:
        stop = int(np.searchsorted(stamps, end, side="right"))
        part = slice(at, stop)
        blocks.append((dt[part], readings[part], dt[part].tolist(), readings[part].tolist()))
        at = stop
    return blocks


def _available() -> tuple[list[Flights], list[str]]:
    """Return the contenders whose packages are there, and what is said of the others."""
    found = [
        Flights("live step", lambda run: Compiled(run, False, 0.0)),
        Flights("live step, covariance every 10 ms", lambda run: Compiled(run, False, 0.01 - 1e-6)),
        Flights("batch step", lambda run: Compiled(run, True, 0.0), arrays=True),
        Flights(
            "batch step, covariance every 10 ms",
            lambda run: Compiled(run, True, 0.01 - 1e-6),
            arrays=True,
        ),
        Flights("careful NumPy", Careful),
    ]
    missing = []
    peers = (("filterpy", Filterpy, "filterpy.kalman"), ("GTSAM", Gtsam, "gtsam"))
    for name, kind, module in peers:
        try:
            __import__(module)
        except ImportError as error:
            missing.append(f"{name} is left out: {error}; pip install -e '.[benchmark]' brings it.")
        else:
            found.append(Flights(name, kind, arrays=name == "GTSAM"))
    return found, missing


def measure(quick: bool) -> Section:
    """Fly all contenders in turn, again and again; then the calls around the filter."""
    section = Section("Filter kernel")
    run = draw(
        Scenario(
            "benchmark",
            rate=RATE,
            fix_rate=FIX_RATE,
            scored_from=5.0,
            duration=12.0 if quick else 60.0,
        ),
        seed=1,
    )
    blocks = _blocks(run)
    contenders, missing = _available()
    for contender in contenders:  # compiles, and fills caches
        contender.make(run).block(*blocks[0][:2] if contender.arrays else blocks[0][2:])
    for repetition in range(2 if quick else 15):
        # Nobody is always first.
        shift = repetition % len(contenders)
        for contender in contenders[shift:] + contenders[:shift]:
            contender.fly(run, blocks)
    careful = next(c for c in contenders if c.name == "careful NumPy")
    bars = {"live step": (12.0, 16.0), "batch step": (28.0, 45.0)}
    for c in contenders:
        section.add(c.name, "µs", c.step)
        section.add(f"{c.name}, CPU", "µs", c.step_cpu)
    for c in contenders:
        if c is not careful:
            bar, stretch = bars.get(c.name, (None, None))
            section.add(
                f"careful NumPy / {c.name}",
                "×",
                ratios(careful.step, c.step),
                bar,
                stretch,
                higher=True,
            )
        if c.name in bars:
            section.add(
                f"careful NumPy / {c.name}, CPU",
                "×",
                ratios(careful.step_cpu, c.step_cpu),
                *bars[c.name],
                higher=True,
            )
    rows = [["", "step [µs]", "fix [µs]", "position RMSE [m]", "position NEES (3)"]]
    rows += [
        [
            c.name,
            f"{np.median(c.step):.3g}",
            f"{np.median(c.update):.3g}",
            f"{c.rmse:.4f}",
            f"{c.nees:.2f}" if np.isfinite(c.nees) else "-",
        ]
        for c in contenders
    ]
    section.tables.append(
        (
            f"The same {run.samples['t_ns'].size / RATE:.0f} s flight, {RATE:.0f} Hz IMU, "
            f"{FIX_RATE:.0f} Hz fixes, scored midway between fixes",
            rows,
        )
    )
    section.remarks += missing
    section.remarks += [
        "A step is mechanisation, F, Q and covariance of 15 states, called from Python; a batch "
        "takes the samples between two fixes (20 here) in one call.",
        "filterpy has no navigation: its Kalman filter runs inside the careful mechanisation. "
        "GTSAM preintegrates (combined IMU factor, flat Earth without its rotation) and solves "
        "with ISAM2 at every fix.",
    ]
    _around(section, run, quick)
    return section


def _around(section: Section, run: Run, quick: bool) -> None:
    """GNSS update, rewind, regressor, and all that the node computes for one sample."""
    repetitions, calls = (2, 20) if quick else (15, 100)
    section.add(
        "GNSS update",
        "µs",
        _timed(_update_call(run), repetitions, calls),
        note="gate, noise model and rewind point included",
    )
    for rate in (RATE, 1000.0):
        section.add(
            f"rewind of 0.5 s at {rate:.0f} Hz",
            "µs",
            _rewinds(rate, repetitions, 3 if quick else 10),
        )
    for name, call in _regressor_calls():
        section.add(
            f"regressor call, {name}",
            "µs",
            _timed(call, repetitions, calls),
            note="six channels, window checked",
        )
    section.add(
        "one sample through the node without DDS",
        "µs",
        _timed(_sample_call(), repetitions, 10 * calls),
        note="bytes in, both odometries out as bytes",
    )


def _timed(call: Callable[[], object], repetitions: int, calls: int) -> list[float]:
    """Return the mean time of a call [µs], once for each repetition."""
    for _ in range(3):
        call()
    times = []
    for _ in range(repetitions):
        start = time.perf_counter()
        for _ in range(calls):
            call()
        times.append((time.perf_counter() - start) / calls * 1e6)
    return times


def _filter(run: Run, rate: float) -> tuple[InsFilter, ImuRing]:
    ring = ImuRing()
    ring.extend(run.samples[:1])
    ins = InsFilter(
        run.start,
        int(run.samples["t_ns"][0]),
        np.array(reading(run, 0)),
        FilterNoise(ConstantNoise(run.q[0]), ProcessNoise(run.bias_walk, 1.0 / rate)),
        Gate({3: np.inf}, 3.0),
        ring,
        FilterSettings(),
    )
    return ins, ring


def _update_call(run: Run) -> Callable[[], None]:
    ins, ring = _filter(run, RATE)
    ring.extend(run.samples[1:200])
    ins.predict_block(run.samples[1:200])
    fix = PositionFix(ins.t_ns, run.start.lla, run.fixes[0].covariance_n, LEVER)

    def call() -> None:
        ins.submit(fix)
        ins.verdicts.clear()

    return call


def _rewinds(rate: float, repetitions: int, fixes: int) -> list[float]:
    """Times [µs] of a fix that is half a second late, in a 5 Hz stream that all are."""
    run = draw(Scenario("late", rate=rate, fix_rate=FIX_RATE, duration=fixes / FIX_RATE + 2.0), 2)
    late_ns = 500_000_000
    stamps = run.samples["t_ns"]
    times = []
    for _ in range(repetitions):
        ins, ring = _filter(run, rate)
        at, spent = 1, []
        for fix in run.fixes:
            stop = int(np.searchsorted(stamps, fix.t_ns + late_ns, side="right"))
            if stop >= len(stamps):
                break
            if stop > at:
                ring.extend(run.samples[at:stop])
                ins.predict_block(run.samples[at:stop])
                at = stop
            start = time.perf_counter()
            ins.submit(fix)
            spent.append(time.perf_counter() - start)
        times.append(float(np.median(spent)) * 1e6)
    return times


def _regressor_calls() -> Iterator[tuple[str, Callable[[], object]]]:
    run = draw(Scenario("window", rate=RATE, duration=5.0), 3)
    ring = ImuRing()
    ring.extend(run.samples)
    t_ns = int(run.samples["t_ns"][-1])
    for model in ("paper", "plateau", "spectral"):
        reader = NoiseReader(
            {**parameters.defaults(), "noise.model": model}, np.eye(3), lambda level, text: None
        )
        yield reader.regressor.name, lambda reader=reader: reader.read(ring, t_ns)


def _sample_call() -> Callable[[], None]:
    values = {
        **parameters.defaults(),
        "alignment.heading_source": "parameter",
        "noise.mode": "constant",
    }
    estimator = Estimator(values, lambda level, text: None)
    decode = ImuDecoder().decode
    imu = StampedEncoder(("imu_link",), 37)
    outputs = [OdometryEncoder("map", "base_link"), OdometryEncoder("odom", "base_link")]
    imu.values[27] = 9.8  # z of the specific force

    fix = new_message("sensor_msgs/msg/NavSatFix")
    fix.latitude, fix.longitude = 32.1, 34.8
    clock = [0]

    def call() -> None:
        clock[0] += 1_000_000
        odometry = estimator.handle_imu(decode(imu.message(clock[0])))
        if odometry is not None:
            for output, values in zip(outputs, odometry[1:], strict=True):
                output.encode_values(odometry.t_ns, values)
        estimator.run_periodic()
        estimator.pop_reports()

    while not estimator.aligned:
        call()
        if clock[0] % 200_000_000 == 0:
            set_stamp(fix.header.stamp, clock[0])
            estimator.handle_fix(fix)
        if clock[0] > 10_000_000_000:
            raise RuntimeError("the benchmark's estimator did not start")
    return call
