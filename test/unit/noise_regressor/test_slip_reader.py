"""The constraint's covariance from the ring of samples: models, checks, bounds, age, axes."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from support.paths import ROOT

from hybrid_ins.core.constraints.nonholonomic import Nose
from hybrid_ins.core.imu.samples import SAMPLE_DTYPE, ImuRing
from hybrid_ins.errors import InputError
from hybrid_ins.noise_regressor.models import Regressor
from hybrid_ins.noise_regressor.slip import HIGHEST, HOLD_NS, LOWEST, SlipReader, SlipRegressor
from hybrid_ins.simulation.road_vehicles import ROAD_VEHICLES
from hybrid_ins.simulation.vehicles import record
from tools.regressor.slip_data import slip_of, unexplained

Array = NDArray[np.float64]

MODEL = ROOT / "models" / "slip.onnx"
STD = np.array([0.1, 0.2])
AHEAD = Nose(0.0, 0.0, np.zeros(3))
RATE = 100


class Lines(list[str]):
    """What the user was told."""

    def __call__(self, level: str, text: str) -> None:
        self.append(f"{level}: {text}")


class Answers:
    """A regressor that gives an answer, or fails with it."""

    name = "answers"
    duration = 1.0
    rate_range = (50.0, 200.0)

    def __init__(self, answer: object) -> None:
        self.answer = answer
        self.windows: list[Array] = []

    def estimate(self, window: Array) -> Array:
        self.windows.append(window)
        if isinstance(self.answer, Exception):
            raise self.answer
        return np.asarray(self.answer, float)


def reader(answer: object = None, mount: Array | None = None) -> SlipReader:
    """A reader with the package's model, or one that gives an answer."""
    made = SlipReader("slip", STD, np.eye(3) if mount is None else mount, Lines())
    if answer is not None:
        made._regressor = Answers(answer)  # type: ignore[assignment]
        made._wanted = ""
    return made


def readings(seconds: float = 2.0, rate: float = RATE, seed: int = 0) -> Array:
    """Readings (N, 6) of a car, forward, right, down."""
    noise = np.random.default_rng(seed).standard_normal((round(seconds * rate), 6))
    return np.array([0.1, -0.2, -9.8, 0.01, 0.02, 0.03]) + noise * np.repeat((0.3, 0.01), 3)


def ring_of(values: Array, rate: float = RATE) -> tuple[ImuRing, int]:
    """A ring, and the stamp of its last sample."""
    samples = np.empty(len(values), SAMPLE_DTYPE)
    samples["t_ns"] = 10**9 + np.rint(1e9 / rate * np.arange(len(values))).astype(np.int64)
    samples["f"], samples["w"] = values[:, :3], values[:, 3:]
    ring = ImuRing()
    ring.extend(samples)
    return ring, int(samples["t_ns"][-1])


# --- Models --------------------------------------------------------------------------------------


def test_the_model_that_comes_with_the_package() -> None:
    pytest.importorskip("onnxruntime", reason="models run in onnxruntime")
    model = SlipRegressor.load(MODEL)

    assert (model.name, model.duration, model.rate_range) == ("slip", 1.0, (50.0, 200.0))
    assert MODEL.stat().st_size < 100_000
    for word in (b"/home", b"/tmp", b"/work", b"site-packages"):
        assert word not in MODEL.read_bytes()


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        (b"hybrid_ins.format", b"hybrid_ins.farmat", "train_slip.py"),
        (b"hybrid_ins.format\x12\x011", b"hybrid_ins.format\x12\x017", "'7'"),
        (b"rate_min\x12\x0250", b"rate_min\x12\x0299", ""),
        (b"rate_max\x12\x03200", b"rate_max\x12\x03  1", "rate range 50 to 1"),
        (b"duration\x12\x011", b"duration\x12\x01x", "'x'"),
        (b"variance", b"deviance", "deviance"),
    ],
)
def test_a_wrong_model_gives_way_to_the_constant_with_one_line(
    tmp_path: Path, old: bytes, new: bytes, word: str
) -> None:
    pytest.importorskip("onnxruntime", reason="models run in onnxruntime")
    assert old in MODEL.read_bytes()
    path = tmp_path / "wrong.onnx"
    path.write_bytes(MODEL.read_bytes().replace(old, new))
    log = Lines()
    made = SlipReader(str(path), STD, np.eye(3), log)

    made.prepare()
    made.prepare()
    covariance = made.read(*_at_end(ring_of(readings())))

    if not word:  # another rate range is a valid model
        assert not log and made.source.startswith("learned")
        return
    np.testing.assert_array_equal(covariance, np.diag(STD**2))
    assert made.source == "constant"
    assert len(log) == 1
    assert log[0].startswith(f"warn: vehicle.slip_model: {path}: ")
    assert word in log[0] and log[0].endswith("vehicle.slip_std is used instead")
    assert "\n" not in log[0]


def _at_end(filled: tuple[ImuRing, int]) -> tuple[ImuRing, Nose, int]:
    return filled[0], AHEAD, filled[1]


@pytest.mark.parametrize("name", ["slap", "/nowhere/slip.onnx"])
def test_a_missing_model_gives_way_too(name: str) -> None:
    log = Lines()
    made = SlipReader(name, STD, np.eye(3), log)

    np.testing.assert_array_equal(made.read(*_at_end(ring_of(readings()))), np.diag(STD**2))
    assert len(log) == 1 and name in log[0]


def test_models_of_the_other_kind_are_refused() -> None:
    pytest.importorskip("onnxruntime", reason="models run in onnxruntime")
    with pytest.raises(InputError, match=r"hybrid_ins\.centred|hybrid_ins\.window"):
        Regressor.load(MODEL)
    with pytest.raises(InputError, match=r"hybrid_ins\.duration"):
        SlipRegressor.load(ROOT / "models" / "plateau.onnx")


def test_without_onnxruntime_the_constant_serves(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    log = Lines()
    made = SlipReader("slip", STD, np.eye(3), log)

    np.testing.assert_array_equal(made.read(*_at_end(ring_of(readings()))), np.diag(STD**2))
    assert len(log) == 1 and "install onnxruntime" in log[0]


def test_no_model_is_loaded_before_it_is_needed_nor_where_none_is_wanted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(SlipRegressor, "load", lambda path: pytest.fail("it was loaded"))

    SlipReader("slip", STD, np.eye(3), Lines())
    none = SlipReader("", STD, np.eye(3), Lines())

    np.testing.assert_array_equal(none.read(*_at_end(ring_of(readings()))), np.diag(STD**2))
    assert none.source == "constant" and not none.fault


# --- Windows and answers -------------------------------------------------------------------------


def test_the_answer_is_used_within_bounds() -> None:
    for answer, expected in (
        ([0.04, 0.09], [0.04, 0.09]),
        ([1e-9, 1e-9], (LOWEST * STD) ** 2),
        ([1e6, 1e6], (HIGHEST * STD) ** 2),
    ):
        made = reader(answer)
        covariance = made.read(*_at_end(ring_of(readings())))

        np.testing.assert_allclose(covariance, np.diag(expected))
        assert made.source == "learned (answers)"


@pytest.mark.parametrize("answer", [[np.nan, 1.0], [0.1, -0.1], [0.0, 0.1], RuntimeError("no")])
def test_an_answer_that_is_no_variance_is_refused(answer: object) -> None:
    made = reader(answer)

    np.testing.assert_array_equal(made.read(*_at_end(ring_of(readings()))), np.diag(STD**2))
    assert "the model" in made.fault and made.refusals == {made.fault: 1}


def broken(fault: str) -> tuple[ImuRing, int]:
    values, rate = readings(), float(RATE)
    if fault == "a reading is not finite":
        values[-5, 2] = np.nan
    elif fault == "samples repeat":
        values[-60:] = values[-60]
    elif fault == "a channel is saturated":
        values[:, 0] = np.minimum(values[:, 0] * 3.0, 0.3)
    elif fault == "sampling rate outside the model's range":
        rate = 400.0
        values = readings(2.0, rate)
    ring, t_ns = ring_of(values, rate)
    if fault == "samples are missing":
        samples = ring.latest(len(values))
        ring.clear()
        ring.extend(np.concatenate((samples[:-50], samples[-40:])))
    if fault == "window not full yet":
        samples = ring.latest(60)
        ring.clear()
        ring.extend(samples)
    return ring, t_ns


@pytest.mark.parametrize(
    "fault",
    [
        "a reading is not finite",
        "samples repeat",
        "a channel is saturated",
        "sampling rate outside the model's range",
        "samples are missing",
        "window not full yet",
    ],
)
def test_a_window_that_says_nothing_is_refused_and_counted(fault: str) -> None:
    made = reader([0.04, 0.09])

    covariance = made.read(*_at_end(broken(fault)))

    np.testing.assert_array_equal(covariance, np.diag(STD**2))
    assert made.refusals == {fault: 1}
    assert made.fault == fault and made.source == "constant"


def test_an_answer_outlasts_a_bad_window_but_not_for_long() -> None:
    made = reader([0.04, 0.09])
    ring, t_ns = ring_of(readings())
    made.read(ring, AHEAD, t_ns)
    ring.clear()

    held = made.read(ring, AHEAD, t_ns + HOLD_NS)
    assert made.source == "learned (answers)" and made.fault
    over = made.read(ring, AHEAD, t_ns + HOLD_NS + 1)

    np.testing.assert_allclose(held, np.diag([0.04, 0.09]))
    np.testing.assert_array_equal(over, np.diag(STD**2))
    assert made.source == "constant"


def test_stamps_that_go_back_end_an_answer() -> None:
    made = reader([0.04, 0.09])
    ring, t_ns = ring_of(readings())
    made.read(ring, AHEAD, t_ns)
    ring.clear()

    np.testing.assert_array_equal(made.read(ring, AHEAD, t_ns - 10**8), np.diag(STD**2))


@pytest.mark.parametrize("rate", [50, 100, 104, 200])
def test_the_model_is_given_one_second_along_the_nose(rate: int) -> None:
    made = reader([0.04, 0.09])
    values = readings(2.0, rate)
    nose = Nose(0.4, 0.1, np.zeros(3))
    C = np.vstack((nose.forward, nose.axes))
    ring, t_ns = ring_of(np.hstack((values[:, :3] @ C, values[:, 3:] @ C)), rate)

    made.read(ring, nose, t_ns)

    (window,) = made._regressor.windows  # type: ignore[union-attr]
    assert window.shape == (6, rate - rate % 10)
    np.testing.assert_allclose(window, values[-window.shape[1] :].T, atol=1e-12)


# --- What the model knows ------------------------------------------------------------------------


def test_variances_follow_the_road() -> None:
    """GIVEN cars of even seeds on roads of each kind WHEN read THEN σ is that of their slip."""
    pytest.importorskip("onnxruntime", reason="models run in onnxruntime")
    std, true = {}, {}
    for name in ("road car, smooth", "road car", "road car, rough"):
        vehicle = replace(ROAD_VEHICLES[name], duration=60.0)
        drive = record(vehicle, 2)
        speed, slip = slip_of(drive)[:, 0], unexplained(drive)
        samples = np.hstack((drive.imu.specific_force, drive.imu.angular_rate))
        found, seen = [], []
        for end in range(2000, len(samples), 50):
            if speed[end] < 2.0:
                continue
            made = reader()
            covariance = made.read(*_at_end(ring_of(samples[end - 150 : end])))
            assert made.source == "learned (slip)", made.fault
            found.append(np.diag(covariance))
            seen.append(slip[end])
        std[name] = np.sqrt(np.mean(found, axis=0))
        true[name] = np.sqrt(np.mean(np.square(seen), axis=0))

    smooth, ordinary, rough = std.values()
    assert np.all(smooth <= ordinary) and np.all(ordinary < rough)
    assert rough[1] > 2.0 * ordinary[1]
    for name in ("road car", "road car, rough"):
        assert np.all(np.abs(np.log(std[name] / true[name])) < np.log(1.6)), (std, true)


def test_slip_is_what_the_place_of_the_axle_and_squat_leave() -> None:
    """
    GIVEN a car whose tyres slip out of turns and whose body squats
    WHEN it is trained or judged what the samples show of the slip
    THEN a fifth of that of the axle's variance to the right is left, and no mean over seconds.
    """
    drive = record(replace(ROAD_VEHICLES["road car, smooth"], duration=200.0), 3)
    axle, left = slip_of(drive)[2000:, 1:], unexplained(drive)[2000:]

    share = np.mean(left**2, axis=0) / np.mean(axle**2, axis=0)
    assert np.all(share < [0.4, 0.2])
    batches = left[: 400 * (len(left) // 400)].reshape(-1, 400, 2).mean(axis=1)
    assert np.all(np.std(batches, axis=0) < 0.5 * np.std(left, axis=0))
