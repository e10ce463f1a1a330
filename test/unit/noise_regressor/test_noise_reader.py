"""From the ring of samples to levels: what is refused and counted, bounds, floors, axes, models."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

from hybrid_ins import parameters
from hybrid_ins.bags.messages import new_message
from hybrid_ins.bags.reader import BagReader
from hybrid_ins.cli import calibrate, replay, simulate
from hybrid_ins.core.imu.samples import SAMPLE_DTYPE, ImuRing
from hybrid_ins.core.noise.process_noise import LearnedNoise, NoiseEstimate
from hybrid_ins.errors import InputError
from hybrid_ins.noise_regressor.models import SpectralRegressor
from hybrid_ins.noise_regressor.reader import NoiseReader, load_regressor
from hybrid_ins.ros.estimator.estimator import Estimator
from hybrid_ins.ros.messages.cdr import ImuFields
from hybrid_ins.ros.messages.conversions import mount_matrix

Array = NDArray[np.float64]
TYPES = get_typestore(Stores.ROS2_JAZZY)

RATE = 200
STD = np.repeat((0.02, 0.002), 3)
GRAVITY = np.array([0.1, -0.2, -9.8, 0.01, 0.02, 0.03])
MOUNT = mount_matrix((0.4, -0.3, 2.0))
NO_TURN = np.eye(3)


class Answers:
    """A regressor that answers whatever it is told to."""

    name = "answers"
    window = 200
    rate_range = (100.0, 1000.0)

    def __init__(self, answer: Any) -> None:
        self.answer = answer
        self.windows: list[Array] = []

    def estimate(self, window: Array, rate_hz: float) -> Array:
        self.windows.append(window)
        return np.broadcast_to(np.asarray(self.answer, float), 6).copy()


class Lines(list[str]):
    """What the user was told."""

    def __call__(self, level: str, text: str) -> None:
        self.append(f"{level}: {text}")


def reader(mount: Array = NO_TURN, answer: Any = None, **changes: object) -> NoiseReader:
    """A reader with the spectral regressor, or one that gives an answer."""
    given = {f"noise.{name}": value for name, value in changes.items()}
    values = parameters.check_all({"noise.model": "spectral", **given})
    made = NoiseReader(values, mount, Lines())
    if answer is not None:
        made.regressor = Answers(answer)
    return made


def readings(count: int = 400, std: Array = STD, seed: int = 0) -> Array:
    """Readings (N, 6) of a still IMU in its own axes."""
    return GRAVITY + std * np.random.default_rng(seed).standard_normal((count, 6))


def ring_of(values: Array, mount: Array = NO_TURN, rate: float = RATE) -> ImuRing:
    """A ring as the estimator fills it: turned into b."""
    samples = np.empty(len(values), SAMPLE_DTYPE)
    samples["t_ns"] = 10**9 + np.rint(1e9 / rate * np.arange(len(values))).astype(np.int64)
    samples["f"], samples["w"] = values[:, :3] @ mount.T, values[:, 3:] @ mount.T
    ring = ImuRing()
    ring.extend(samples)
    return ring


def test_the_turns_of_a_vehicle_are_not_taken_for_noise_of_slow_gyroscopes() -> None:
    """GIVEN the same readings at 50 and 200 Hz THEN gyroscopes' noise is read at 200 Hz alone."""
    made, values = reader(q_gyroscope=1e-5), readings()
    slow, fast = (made.read(ring_of(values, rate=rate), 10**10).q for rate in (50.0, 200.0))

    assert slow is not None and fast is not None
    assert slow[:3] == pytest.approx(fast[:3])
    assert slow[3:] == pytest.approx(1e-5)
    assert fast[3:] == pytest.approx(STD[3:] ** 2, rel=0.5)


# --- A recording that is known ahead ---------------------------------------------------------


class Counted(SpectralRegressor):
    """The spectral regressor, which notes how many channels it was given at a time."""

    def __init__(self) -> None:
        super().__init__()
        self.channels: list[int] = []

    def estimate(self, window: Array, rate_hz: float) -> Array:
        self.channels.append(len(window))
        return super().estimate(window, rate_hz)


def levels_of(values: Array, ahead: Array | None) -> tuple[list[Array | None], list[int]]:
    """Levels after every fifth of a second of readings, and what the regressor was given."""
    made, ring = reader(MOUNT), ring_of(values, MOUNT)
    made.regressor = counted = Counted()
    samples = ring.latest(len(values))
    if ahead is not None:
        made.preload(samples["t_ns"], ahead[:, :3], ahead[:, 3:])
    levels = []
    for end in range(220, len(values) + 1, RATE // 5):
        ring = ImuRing()
        ring.extend(samples[:end])
        levels.append(made.read(ring, int(samples["t_ns"][end - 1])).q)
    return levels, counted.channels


def test_windows_that_are_known_ahead_are_read_together() -> None:
    values = readings(2000)

    alone, one_by_one = levels_of(values, None)
    together, many = levels_of(values, values)

    assert set(one_by_one) == {6}
    assert sum(many) == sum(one_by_one)
    assert len(many) < 0.2 * len(one_by_one)
    assert np.array(together) == pytest.approx(np.array(alone), rel=1e-9)


def test_what_comes_counts_and_not_what_was_preloaded() -> None:
    values = readings(2000)
    other = readings(2000, 3.0 * STD, seed=1)

    misled, alone = (np.array(levels_of(values, ahead)[0]) for ahead in (other, None))

    assert misled == pytest.approx(alone, rel=1e-9)


# --- Levels --------------------------------------------------------------------------------------


def test_white_noise_is_read_as_its_variance() -> None:
    estimate = reader().read(ring_of(readings()), 7)

    assert estimate.t_ns == 7
    assert estimate.q == pytest.approx(STD**2, rel=0.5)


def test_the_youngest_window_counts() -> None:
    rough = np.vstack((readings(400, 30.0 * STD), readings(200)))

    assert reader().read(ring_of(rough), 1).q == pytest.approx(STD**2, rel=0.5)


def test_the_regressor_sees_the_sensors_own_axes() -> None:
    values = readings()
    turned = reader(MOUNT, answer=1e-4)
    turned.read(ring_of(values, MOUNT), 1)

    assert isinstance(turned.regressor, Answers)
    assert turned.regressor.windows[0] == pytest.approx(values[-200:].T, abs=1e-9)


def test_variances_are_turned_into_the_body_axes() -> None:
    """Of independent noise, a turned axis has the mean of the variances by squared cosines."""
    own = np.array([1.0, 4.0, 9.0, 1e-2, 2e-2, 5e-2])
    q = reader(MOUNT, answer=own).read(ring_of(readings(), MOUNT), 1).q

    assert q is not None
    assert q[:3] == pytest.approx(np.diag(MOUNT @ np.diag(own[:3]) @ MOUNT.T))
    assert q[3:] == pytest.approx(np.diag(MOUNT @ np.diag(own[3:]) @ MOUNT.T))


def test_levels_are_floored_at_the_lowest_that_is_believed() -> None:
    low = {"q_accelerometer_min": 1e-3, "q_gyroscope_min": 1e-5}
    q = reader(answer=0.0, **low).read(ring_of(readings()), 1).q

    assert q == pytest.approx(np.repeat((1e-3, 1e-5), 3))


@pytest.mark.parametrize("rate", [RATE, 50.0])
@pytest.mark.parametrize("mount", [NO_TURN, MOUNT], ids=["straight", "turned"])
def test_levels_are_floored_at_the_noise_of_the_quantisation(mount: Array, rate: float) -> None:
    """Those of slow gyroscopes, too: the constant of 1e-7 counted below 100 Hz."""
    step = np.repeat((0.06, 0.004), 3)
    coarse = np.round(readings() / step) * step
    made = reader(mount, answer=0.0, q_gyroscope=1e-7)
    made.regressor.rate_range = (20.0, 1000.0)
    q = made.read(ring_of(coarse, mount, rate), 1).q

    assert q == pytest.approx(step**2 / 12.0, rel=1e-6)


# --- Refusals ------------------------------------------------------------------------------------


def frozen(values: Array) -> Array:
    values[-60:] = values[-60]
    return values


def cut_off(values: Array) -> Array:
    values[:, 1] = np.minimum(values[:, 1], np.quantile(values[:, 1], 0.8))
    return values


def not_a_number(values: Array) -> Array:
    values[-5, 4] = np.nan
    return values


FAULTS: dict[str, Callable[[Array], Array]] = {
    "samples repeat": frozen,
    "a reading is not finite": not_a_number,
}


@pytest.mark.parametrize("mount", [NO_TURN, MOUNT], ids=["straight", "turned"])
@pytest.mark.parametrize("fault", FAULTS)
def test_a_bad_window_is_refused_by_name_and_counted(fault: str, mount: Array) -> None:
    noise = reader(mount, answer=1e-4)
    ring = ring_of(FAULTS[fault](readings()), mount)

    assert noise.read(ring, 5).q is None
    assert noise.read(ring, 6).q is None
    assert noise.fault == fault
    assert noise.refusals == {fault: 2}


@pytest.mark.parametrize("mount", [NO_TURN, MOUNT], ids=["straight", "turned"])
def test_readings_that_are_cut_off_show_the_least_noise_there_is(mount: Array) -> None:
    noise = reader(mount, answer=1e-4)

    estimate = noise.read(ring_of(cut_off(readings()), mount), 5)

    assert estimate.q == pytest.approx(np.full(6, 1e-4)) and estimate.at_least
    assert noise.fault == "" and not noise.refusals
    assert not noise.read(ring_of(readings(), mount), 6).at_least


def test_a_good_window_ends_the_fault_but_not_the_count() -> None:
    noise = reader(answer=1e-4)
    noise.read(ring_of(frozen(readings())), 1)

    assert noise.read(ring_of(readings()), 2).q is not None
    assert noise.fault == ""
    assert noise.refusals == {"samples repeat": 1}


def test_a_window_needs_its_samples() -> None:
    noise = reader(answer=1e-4)

    assert noise.read(ring_of(readings(199)), 1).q is None
    assert noise.fault == "window not full yet"
    assert noise.read(ring_of(readings(200)), 1).q is not None


def test_a_gap_and_a_rate_beyond_the_models_are_refused() -> None:
    noise = reader(answer=1e-4)
    holed = ring_of(readings())
    samples = holed.latest(400)
    with_gap = ImuRing()
    with_gap.extend(np.concatenate((samples[:300], samples[310:])))

    assert noise.read(with_gap, 1).q is None
    assert noise.fault == "samples are missing"
    assert noise.read(ring_of(readings(), rate=60.0), 1).q is None
    assert noise.fault == "sampling rate outside the model's range"


def test_vibration_between_the_samples_that_are_left_counts_as_noise() -> None:
    """
    A tone of 60 Hz integrates to nothing, unless samples are missing.

    What integrating the rest wrongly adds is the velocity error that the level has to contain.
    """
    found = []
    for seed in range(20):
        rng, whole, stretch = np.random.default_rng(seed), readings(seed=seed), RATE // 5
        whole[:, 0] += np.sin(2.0 * np.pi * (60.0 * np.arange(400) / RATE + rng.random()))
        samples = ring_of(whole).latest(400)
        left = samples[rng.random(400) > 0.35]
        lossy = ImuRing()
        lossy.extend(left)
        noise = reader()

        q_whole, q = noise.read(ring_of(whole), 1).q, noise.read(lossy, 1).q

        assert q is not None and q_whole is not None and noise.fault == ""
        wrong = np.interp(samples["t_ns"], left["t_ns"], left["f"][:, 0]) - whole[:, 0]
        errors = wrong.reshape(-1, stretch).sum(axis=1)
        found.append((q_whole[0], q[0], np.mean(errors**2) / stretch))
    q_whole, q, needed = np.median(found, axis=0)
    assert q == pytest.approx(needed, rel=0.5)
    assert q_whole < 0.01 * needed


@pytest.mark.parametrize("answer", [np.nan, -1e-4, np.inf, [1e-4] * 5 + [np.nan]])
def test_an_answer_that_is_no_variance_is_refused(answer: Any) -> None:
    noise = reader(answer=answer)

    assert noise.read(ring_of(readings()), 1).q is None
    assert noise.refusals == {"the model answered with no variance": 1}


def test_a_model_that_fails_is_refused() -> None:
    noise = reader(answer=1e-4)

    def fail(window: Array, rate_hz: float) -> Array:
        raise RuntimeError("the runtime's own")

    noise.regressor.estimate = fail  # type: ignore[method-assign]
    assert noise.read(ring_of(readings()), 1).q is None
    assert noise.refusals == {"the model failed": 1}


@pytest.mark.parametrize("channel", [0, 5])
def test_levels_beyond_the_highest_are_refused(channel: int) -> None:
    high = {"q_accelerometer_max": 1.0, "q_gyroscope_max": 1e-2}
    answer = np.repeat((0.99, 0.99e-2), 3)
    assert reader(answer=answer, **high).read(ring_of(readings()), 1).q is not None
    answer[channel] *= 1.1
    noise = reader(answer=answer, **high)

    assert noise.read(ring_of(readings()), 1).q is None
    assert noise.refusals == {"noise beyond noise.q_*_max": 1}


# --- Models --------------------------------------------------------------------------------------


def test_the_spectral_estimator_needs_no_file_and_says_nothing() -> None:
    lines = Lines()

    assert isinstance(load_regressor("spectral", lines), SpectralRegressor)
    assert not lines


def test_models_that_come_with_the_package_load() -> None:
    pytest.importorskip("onnxruntime", reason="models run in onnxruntime")
    lines = Lines()

    assert [load_regressor(name, lines).name for name in ("plateau", "paper")] == [
        "plateau",
        "paper",
    ]
    assert not lines


@pytest.mark.parametrize("content", [None, b"", b"no model\n" * 1000])
def test_an_unusable_model_gives_way_to_the_spectral_estimator_with_one_line(
    tmp_path: Path, content: bytes | None
) -> None:
    path = tmp_path / "model.onnx"
    if content is not None:
        path.write_bytes(content)
    lines = Lines()

    assert isinstance(load_regressor(str(path), lines), SpectralRegressor)
    assert len(lines) == 1
    level = "error" if content is None else "warn"
    assert lines[0].startswith(f"{level}: noise.model: ")
    assert str(path) in lines[0] and "spectral" in lines[0] and "\n" not in lines[0]


def test_an_unknown_name_gives_way_too() -> None:
    lines = Lines()

    assert isinstance(load_regressor("platoon", lines), SpectralRegressor)
    assert len(lines) == 1 and lines[0].startswith("error: noise.model: ")
    assert "platoon" in lines[0] and "plateau, spectral, paper" in lines[0]


def test_without_onnxruntime_the_spectral_estimator_serves(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    lines = Lines()

    assert isinstance(load_regressor("plateau", lines), SpectralRegressor)
    assert len(lines) == 1 and "install onnxruntime" in lines[0]


# --- In the estimator ----------------------------------------------------------------------------


class Standing:
    """An estimator on a standing vehicle, fed by messages."""

    def __init__(self, **changes: object) -> None:
        self.lines = Lines()
        given = {name.replace("__", "."): value for name, value in changes.items()}
        self.estimator = Estimator(
            parameters.check_all(
                {
                    "alignment.heading_source": "parameter",
                    "alignment.yaw_std": 0.01,
                    "imu.zero_updates": False,
                    "noise.innovation_scale": False,
                    **given,
                }
            ),
            self.lines,
        )
        self.rng = np.random.default_rng(1)
        self.t_ns = 10**9
        self.last = np.zeros(6)

    def feed(self, duration: float, *, stuck: bool = False, std: Array = STD) -> Standing:
        """Feed samples at 200 Hz and fixes at 5 Hz; ``stuck`` repeats the last sample."""
        for k in range(round(duration * RATE)):
            self.t_ns += 10**9 // RATE
            if not stuck:
                self.last = std * self.rng.standard_normal(6)
                self.last[2] += 9.7955
            force, rate = tuple(self.last[:3]), tuple(self.last[3:])
            self.estimator.handle_imu(ImuFields(self.t_ns, force, rate))
            self.estimator.run_periodic()
            if k % 40 == 0:
                self._fix()
        return self

    def _fix(self) -> None:
        fix = new_message("sensor_msgs/msg/NavSatFix")
        fix.header.stamp.sec, fix.header.stamp.nanosec = divmod(self.t_ns, 10**9)
        fix.latitude, fix.longitude, fix.altitude = 32.1, 34.8, 0.0
        fix.position_covariance = np.diag([0.01, 0.01, 0.02]).ravel()
        fix.position_covariance_type = 2
        self.estimator.handle_fix(fix)

    @property
    def noise(self) -> Any:
        assert self.estimator.navigator.filter is not None
        return self.estimator.navigator.filter.noise

    @property
    def source(self) -> str:
        """Where the variances come from, as diagnostics say it, without the regressor's name."""
        return self.told["source"].split(" ")[0]

    @property
    def told(self) -> dict[str, str]:
        """The diagnostics of the process noise."""
        statuses = self.estimator.status.diagnostics(self.t_ns)
        status = next(s for s in statuses if "noise" in s.name)
        return {"message": status.text, **dict(status.values)}


def test_levels_are_learned_and_published() -> None:
    standing = Standing(noise__model="spectral").feed(4.0)

    assert standing.source == "learned"
    assert standing.noise.levels() == pytest.approx(STD**2, rel=0.6)
    reports = {report.topic: report.content for report in standing.estimator.pop_reports()}
    assert reports["q/accelerometer"].xyz == pytest.approx(standing.noise.levels()[:3])
    assert "learned" in standing.told["source"] and "spectral" in standing.told["source"]


def test_an_imu_that_repeats_itself_falls_back_within_a_second_and_comes_back() -> None:
    standing = Standing(noise__model="spectral", noise__q_accelerometer=0.1).feed(4.0)
    assert standing.source == "learned"

    standing.feed(1.3, stuck=True)  # a window is refused once it repeats for 10 samples
    assert standing.source == "fallback"
    assert standing.noise.levels()[:3] == pytest.approx(np.full(3, 0.1))
    assert "samples repeat" in standing.told["message"]
    assert float(standing.told["refused: samples repeat"]) >= 4

    standing.feed(2.0)
    assert standing.source == "learned"
    assert standing.noise.levels() == pytest.approx(STD**2, rel=0.6)
    assert "refused" not in standing.told["message"]


@pytest.mark.parametrize("period", [0.05, 0.2, 0.35, 0.51, 0.7, 1.0])
def test_refused_estimates_give_way_within_a_second(period: float) -> None:
    noise = LearnedNoise(np.ones(6))
    noise.learn(NoiseEstimate(0, np.full(6, 2.0)))
    given_way = 0
    for k in range(1, 60):
        noise.learn(NoiseEstimate(round(k * period * 1e9), None))
        if noise.on_fallback:
            given_way = round(k * period * 1e9)
            break

    assert 0 < given_way <= 1_000_000_000
    assert noise.levels().tolist() == [1.0] * 6
    noise.learn(NoiseEstimate(given_way + 1, np.full(6, 3.0)))
    assert not noise.on_fallback


@pytest.mark.parametrize(
    ("changes", "source"),
    [
        ({"noise.mode": "constant", "noise.q_accelerometer": 0.05}, "constant"),
        ({"noise.mode": "cq2"}, "constant"),
        ({"noise.mode": "innovation", "noise.innovation_window": 5}, "innovation"),
        ({"noise.mode": "learned", "noise.model": "spectral"}, "fallback"),
        ({"noise.units": "paper"}, "fallback"),
    ],
)
def test_the_mode_changes_at_run_time_without_losing_the_state(
    changes: dict[str, Any], source: str
) -> None:
    standing = Standing(noise__model="spectral").feed(4.0)
    running = standing.estimator.navigator.filter
    assert running is not None
    before = running.state

    standing.estimator.change(parameters.check_change(standing.estimator.values, changes))

    after = running.state
    assert standing.estimator.navigator.filter is running
    assert after.lla.tolist() == before.lla.tolist()
    assert after.velocity_n.tolist() == before.velocity_n.tolist()
    assert after.quat_xyzw.tolist() == before.quat_xyzw.tolist()
    np.testing.assert_allclose(after.P, before.P, rtol=1e-12)
    assert standing.source == source
    standing.feed(1.0)
    assert standing.estimator.navigator.filter is running
    assert standing.source == ("learned" if source == "fallback" else source)


def test_a_constant_is_in_force_at_once() -> None:
    standing = Standing(noise__model="spectral").feed(3.0)
    running = standing.estimator.navigator.filter
    assert running is not None
    standing.estimator.change({"noise.mode": "constant", "noise.q_gyroscope": 1e-3})

    assert running.noise.levels()[3:] == pytest.approx(np.full(3, 1e-3))
    assert standing.told["mode"] == "constant"


def test_an_unusable_model_at_run_time_is_one_line_and_learning_goes_on(tmp_path: Path) -> None:
    standing = Standing(noise__model="spectral").feed(3.0)
    standing.lines.clear()
    standing.estimator.change({"noise.model": str(tmp_path / "gone.onnx")})
    standing.feed(1.0)

    reasons = [line for line in standing.lines if "spectral estimator is used" in line]
    assert len(reasons) == 1 and "gone.onnx" in reasons[0]
    assert standing.source == "learned"


def test_an_impossible_mode_is_refused_before_anything_changes() -> None:
    with pytest.raises(InputError, match=r"noise\.mode"):
        parameters.check_change(parameters.defaults(), {"noise.mode": "guess"})


# --- On recordings -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    assert simulate.main([str(path), "--duration", "20", "--imu-rate", "200"]) == 0
    return path


@pytest.mark.parametrize("program", [replay.main, calibrate.main])
@pytest.mark.parametrize("model", ["foo", "foo.onnx"])
def test_a_model_that_is_none_ends_a_program(
    tmp_path: Path, program: Any, model: str, capsys: pytest.CaptureFixture[str]
) -> None:
    bag, out = str(tmp_path / "run.mcap"), str(tmp_path / "out.mcap")

    assert program([bag, *([out] if program is replay.main else []), "-p", f"noise.model:={model}"])

    [line] = capsys.readouterr().err.splitlines()
    assert "error: parameter noise.model: " in line
    assert model in line and "plateau, spectral, paper, or the path of an .onnx file" in line


def test_a_replay_goes_on_with_a_damaged_model_and_says_so(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, out = tmp_path / "model.onnx", tmp_path / "out.mcap"
    model.write_bytes(b"no model\n" * 1000)
    assert replay.main([str(recording), str(out), "-p", f"noise.model:={model}"]) == 0

    said = [line for line in capsys.readouterr().err.splitlines() if "noise.model" in line]
    assert len(said) == 1
    assert str(model) in said[0] and "spectral estimator is used instead" in said[0]
    with BagReader(out) as bag:
        last = [message for _, _, message in bag.messages("/diagnostics")][-1]
    noise = next(status for status in last.status if "noise" in status.name)
    assert {v.key: v.value for v in noise.values}["source"] == "learned (spectral)"
