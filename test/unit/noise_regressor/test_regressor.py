"""Noise regressors: loading refuses what is wrong in one line; estimates keep their symmetries."""

import os
import subprocess
import sys

import numpy as np
import pytest
from support.paths import ROOT

from hybrid_ins.core.noise import spectral as noise_spectral
from hybrid_ins.errors import InputError
from hybrid_ins.noise_regressor import onnx_model
from hybrid_ins.noise_regressor.models import Regressor, SpectralRegressor
from hybrid_ins.noise_regressor.window import (
    WindowFault,
    find_fault,
    quantisation_step,
    sampling_rate,
)
from tools.regressor import noise_data, noise_randomised, noise_trials, vehicle_levels

MODELS = ROOT / "models"
PLATEAU = MODELS / "plateau.onnx"
PAPER = MODELS / "paper.onnx"


@pytest.fixture(scope="module")
def plateau():
    pytest.importorskip("onnxruntime", reason="models run in onnxruntime")
    return Regressor.load(PLATEAU)


@pytest.fixture(scope="module")
def paper():
    pytest.importorskip("onnxruntime", reason="models run in onnxruntime")
    return Regressor.load(PAPER)


def white(level=1.0, channels=6, seed=0, window=200):
    return np.random.default_rng(seed).normal(0.0, np.sqrt(level), (channels, window))


def low_passed(corner, order, seed, windows=2000):
    """Noise behind a low-pass with a corner [cycles/sample], its plateau at 1."""
    spectrum = noise_randomised.low_pass_spectrum(
        noise_randomised.shaping_grid(200), np.full(windows, corner), np.full(windows, order)
    )
    return noise_randomised.shaped_noise(np.random.default_rng(seed), spectrum, 200)


# --- Loading -------------------------------------------------------------------------------------


def test_models_declare_what_they_need(plateau, paper):
    for model, name in ((plateau, "plateau"), (paper, "paper")):
        assert model.name == name
        assert model.window == 200
        assert model.rate_range == ((100.0, 1000.0) if name == "paper" else (25.0, 1000.0))


def test_the_runtime_sends_nothing_and_keeps_nothing(tmp_path):
    """GIVEN a new home WHEN a model is loaded and asked THEN no file appears there."""
    pytest.importorskip("onnxruntime", reason="models run in onnxruntime")
    code = (
        "import sys, numpy, hybrid_ins.noise_regressor.models as m;"
        "print(m.Regressor.load(sys.argv[1]).estimate(numpy.ones((6, 200)), 200.0).shape)"
    )
    kept = {"PATH", "PYTHONPATH", "LD_LIBRARY_PATH"}
    environment = {name: value for name, value in os.environ.items() if name in kept}

    done = subprocess.run(
        [sys.executable, "-c", code, str(PLATEAU)],
        env=environment | {"HOME": str(tmp_path), "NUMBA_CACHE_DIR": str(tmp_path / "numba")},
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    )

    assert done.stdout.split() == ["(6,)"]
    left = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert not [path for path in left if "numba" not in path.parts]


def patched(tmp_path, *changes):
    """Write the plateau model with bytes replaced by others of the same length."""
    content = PLATEAU.read_bytes()
    for old, new in changes:
        assert len(old) == len(new)
        assert old in content
        content = content.replace(old, new)
    path = tmp_path / "model.onnx"
    path.write_bytes(content)
    return path


def scalar(value):
    return np.float32(value).tobytes()


NAN = scalar(np.nan)
REFUSALS = {
    "foreign operator": ([(b"LogSoftmax", b"LogSoftmux")], "LogSoftmux"),
    "no metadata": ([(b"hybrid_ins.format", b"hybrid_ins.farmat")], "hybrid_ins.format"),
    "no window": ([(b"hybrid_ins.window", b"hybrid_ins.windaw")], "hybrid_ins.window"),
    "other format": ([(b"hybrid_ins.format\x12\x011", b"hybrid_ins.format\x12\x017")], "'7'"),
    "word for a number": ([(b"window\x12\x03200", b"window\x12\x03abc")], "'abc'"),
    "wrong window": ([(b"window\x12\x03200", b"window\x12\x03150")], "150"),
    "wrong rates": ([(b"rate_max\x12\x041000", b"rate_max\x12\x040010")], "10"),
    "wrong name": ([(b"variance", b"deviance")], "deviance"),
    "NaN": ([(scalar(12.0), NAN), (scalar(3.0), NAN), (scalar(2.0), NAN)], "nan"),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_a_wrong_model_is_refused_in_one_line(tmp_path, plateau, case):
    changes, word = REFUSALS[case]
    path = patched(tmp_path, *changes)
    with pytest.raises(InputError) as refusal:
        Regressor.load(path)
    text = str(refusal.value)
    assert text.startswith(f"{path}: ")
    assert word in text
    assert "\n" not in text


def test_missing_directory_corrupt_and_empty_files(tmp_path, plateau):
    whole = PLATEAU.read_bytes()
    (tmp_path / "cut.onnx").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "noise.onnx").write_bytes(np.random.default_rng(0).bytes(10_000))
    (tmp_path / "empty.onnx").write_bytes(b"")
    (tmp_path / "text.onnx").write_text("version https://example.invalid/large-file/v1\n")
    (tmp_path / "folder.onnx").mkdir()
    for name in ("missing", "cut", "noise", "empty", "text", "folder"):
        with pytest.raises(InputError) as refusal:
            Regressor.load(tmp_path / f"{name}.onnx")
        assert str(refusal.value).startswith(f"{tmp_path / name}.onnx: ")
        assert "\n" not in str(refusal.value)


def test_an_oversized_file_is_refused_before_it_is_read(tmp_path, monkeypatch):
    path = tmp_path / "huge.onnx"
    with path.open("wb") as file:
        file.truncate(5_000_000_000)  # sparse
    monkeypatch.setattr("os.fdopen", lambda *_, **__: pytest.fail("it was read"))
    with pytest.raises(InputError, match="5000 MB is larger than a model"):
        Regressor.load(path)


def test_models_hold_no_path_of_the_machine_that_made_them():
    for path in (PLATEAU, PAPER):
        content = path.read_bytes()
        assert len(content) < 5_000_000
        for word in (b"/home", b"/tmp", b"/work", b"site-packages", b"\\Users"):
            assert word not in content


def test_importing_the_regressor_does_not_import_onnxruntime():
    code = "import sys, hybrid_ins.noise_regressor.models; sys.exit('onnxruntime' in sys.modules)"
    root = str(PLATEAU.parent.parent)
    assert subprocess.run([sys.executable, "-c", code], cwd=root, check=False).returncode == 0


# --- Estimates -----------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [2.0**-12, 2.0**-3, 2.0, 2.0**10])
def test_scaling_by_a_power_of_two_scales_the_plateau_exactly(plateau, scale):
    window = white() + np.linspace(0.0, 3.0, 200)
    # The offset removed below rounds the same way at every power of two.
    assert plateau.estimate(window * scale, 100.0) == pytest.approx(
        plateau.estimate(window, 100.0) * scale**2, rel=1e-6
    )


def test_any_scale_and_offset(plateau):
    window = white()
    base = plateau.estimate(window, 100.0)
    for scale in (1e-4, 0.37, 55.0, 1e4):
        assert plateau.estimate(window * scale, 100.0) == pytest.approx(base * scale**2, rel=1e-4)
    for offset in (-1000.0, -9.81, 3.0, 1000.0):
        assert plateau.estimate(window + offset, 100.0) == pytest.approx(base, rel=1e-3)
    small = plateau.estimate(1e-3 * window + 1000.0, 100.0)
    assert small == pytest.approx(1e-6 * base, rel=1e-3)


def test_channels_do_not_mix(plateau, paper):
    window = white(0.01)
    for model in (plateau, paper, SpectralRegressor()):
        together = model.estimate(window, 100.0)
        alone = [model.estimate(row[None], 100.0)[0] for row in window]
        assert together == pytest.approx(alone, rel=1e-5)


def test_a_window_of_wrong_length_is_a_defect_of_the_caller(plateau):
    with pytest.raises(ValueError, match="200"):
        plateau.estimate(white(window=100), 100.0)


@pytest.mark.parametrize("kind", ["plateau", "spectral"])
def test_still_and_extreme_windows_give_finite_levels(plateau, kind):
    model = plateau if kind == "plateau" else SpectralRegressor()
    still = np.full((6, 200), 9.81)
    assert np.isfinite(model.estimate(still, 100.0)).all()
    assert (model.estimate(still, 100.0) < 1e-10).all()
    spike = np.zeros((6, 200))
    spike[:, 77] = 1e4
    assert np.isfinite(model.estimate(spike, 100.0)).all()


BARS = {
    "clean": (0.10, 1.6),
    "tone of 1 sigma": (0.10, 3.0),
    "tone of 10 sigma": (0.10, 3.5),
    "tone of 100 sigma": (0.10, 4.5),
    "bias of 1000": (0.10, 1.6),
    "30 % duplicates": (0.10, 4.0),
    "low-pass at fs/4, order 1": (0.25, 5.0),
    "low-pass at fs/4, order 2": (0.25, 5.0),
    "low-pass at fs/4, order 4": (0.25, 5.0),
}


def test_plateau_model_under_disturbances(plateau):
    for trial in noise_trials.disturbance_trials(seed=11, count=500):
        ratio = plateau.estimate(trial.windows.readings, 100.0) / trial.windows.variance
        median_off, _ = BARS[trial.name]
        assert np.median(ratio) == pytest.approx(1.0, abs=median_off), trial.name


def test_plateau_model_at_every_level(plateau):
    for trial in noise_trials.level_trials(seed=12, count=600):
        ratio = plateau.estimate(trial.windows.readings, 100.0) / trial.windows.variance
        assert np.sqrt(np.mean((ratio - 1) ** 2)) < 1.35 * 0.1 * 1.1, trial.name


def test_models_on_the_papers_set(plateau, paper):
    data = noise_data.paper_set(seed=13, duration_s=40.0)
    for model, bar in ((plateau, 0.00165), (paper, 0.0018)):
        off = model.estimate(data.readings, 100.0) - data.variance
        assert np.sqrt(np.mean(off**2)) < bar


def moving(regressor, motion, rate, level):
    """Return median and 95th percentile of estimate over truth: accelerometer, gyroscope."""
    ideal = vehicle_levels.ideal_windows(motion, 8, rate, regressor.window)
    found = vehicle_levels.ratios(regressor, ideal, rate, level, 8)
    return [np.quantile(part, (0.5, 0.95)) for part in (found[:, :3], found[:, 3:])]


@pytest.mark.parametrize("level", [1e-2, 1e-5])
@pytest.mark.parametrize("rate", [100.0, 200.0])
@pytest.mark.parametrize("motion", ["car", "robot on rough ground", "agile quadrotor"])
def test_motion_is_not_taken_for_noise(plateau, motion, rate, level):
    accelerometer, gyroscope = moving(plateau, motion, rate, level)
    assert accelerometer[0] < 1.1 and accelerometer[1] < 1.4
    assert gyroscope[0] < 1.5
    if motion == "car" or (rate, level) != (100.0, 1e-5):  # turns fill the whole band
        assert gyroscope[1] < 1.6


@pytest.mark.parametrize("level", [1e-2, 1e-5])
@pytest.mark.parametrize("rate", [25.0, 50.0])
@pytest.mark.parametrize("motion", ["car", "quadrotor"])
def test_motion_is_not_taken_for_noise_of_a_slow_imu(plateau, motion, rate, level):
    for median, most in moving(plateau, motion, rate, level):
        assert 0.9 < median < 1.1 and most < 1.8


def test_noise_that_a_sensor_smooths_is_not_lost(plateau):
    """What is integrated is the plateau: a filter that trusts less than that is silently wrong."""
    for order in (1.0, 2.0, 3.0):
        noise = low_passed(0.12, order, 5)
        assert np.median(plateau.estimate(noise, 100.0)) > 0.5, order


# --- The estimator without a model ---------------------------------------------------------------


def test_spectral_variance_is_near_the_bound_for_white_noise():
    ratio = noise_spectral.variance(white(channels=5000))
    assert ratio.mean() == pytest.approx(1.0, abs=0.02)
    assert np.sqrt(np.mean((ratio - 1.0) ** 2)) < 1.12 * 0.1


def test_spectral_variance_ignores_slow_motion():
    t = np.linspace(-1.0, 1.0, 200)
    motion = 30.0 + 20.0 * t - 5.0 * t**2 + 9.0 * t**3
    window = white(channels=200)
    assert noise_spectral.variance(window + motion) == pytest.approx(
        noise_spectral.variance(window), rel=1e-6
    )


def test_spectral_plateau_sees_the_low_end():
    grid = noise_randomised.shaping_grid(200)
    one = np.ones(2000)
    for spectrum in (
        noise_randomised.low_pass_spectrum(grid, 0.25 * one, 4 * one),
        noise_randomised.blue_spectrum(grid, 100 * one, 0.35 * one, 4 * one),
    ):
        noise = noise_randomised.shaped_noise(np.random.default_rng(3), spectrum, 200)
        assert np.median(noise_spectral.plateau(noise)) == pytest.approx(1.0, abs=0.35)
        assert abs(np.log(np.median(noise_spectral.variance(noise)))) > 0.5


@pytest.mark.parametrize("level", [1e-2, 1e-5])
@pytest.mark.parametrize("motion", ["car", "agile quadrotor"])
def test_spectral_plateau_is_found_above_fast_motion(motion, level):
    accelerometer, gyroscope = moving(SpectralRegressor(), motion, 100.0, level)
    assert accelerometer[0] < 1.5 and accelerometer[1] < 3.0
    assert gyroscope[0] < 1.6


def test_spectral_plateau_is_not_the_tail_of_a_low_pass():
    for order in (1.0, 2.0, 4.0):
        noise = low_passed(0.25, order, 4)
        assert np.quantile(noise_spectral.plateau(noise), 0.02) > 0.15


def test_spectral_needs_a_window():
    with pytest.raises(ValueError, match="too short"):
        noise_spectral.variance(np.zeros((6, 20)))


# --- Windows -------------------------------------------------------------------------------------

RATES = (100.0, 1000.0)


def stamped(rate=200.0, count=200, seed=0):
    t_ns = (np.arange(count) * 1e9 / rate).astype(np.int64) + 1_700_000_000_000_000_000
    return t_ns, np.ascontiguousarray(white(0.01, seed=seed, window=count).T)


@pytest.mark.slow
def test_a_good_window_has_no_fault():
    t_ns, readings = stamped()
    assert find_fault(t_ns, readings, RATES) is None
    assert sampling_rate(t_ns) == pytest.approx(200.0)


def test_host_stamp_jitter_is_no_fault():
    t_ns, readings = stamped()
    jitter = np.random.default_rng(1).uniform(0.0, 4e6, t_ns.size).astype(np.int64)
    assert find_fault(t_ns + jitter, readings, RATES) is None


@pytest.mark.parametrize("tick", [16_000_000, 40_000_000])
def test_samples_that_a_driver_stamps_in_bursts_have_their_rate(tick: int) -> None:
    t_ns, readings = stamped()
    arrival = -(-t_ns // tick) * tick  # a serial port hands over what has come every so often
    arrival += 10_000 * np.arange(t_ns.size)
    assert np.median(np.diff(arrival)) < 1e6

    assert sampling_rate(arrival) == pytest.approx(200.0, rel=0.05)
    assert find_fault(arrival, readings, RATES) is None


@pytest.mark.parametrize("missing", [1, 20])
def test_a_gap_does_not_change_the_rate(missing: int) -> None:
    t_ns, _ = stamped()
    assert sampling_rate(np.delete(t_ns, slice(90, 90 + missing))) == pytest.approx(200.0)


@pytest.mark.parametrize(
    ("fault", "spoil"),
    [
        (WindowFault.NOT_FINITE, lambda t, x: x.__setitem__((5, 2), np.nan)),
        (WindowFault.NOT_FINITE, lambda t, x: x.__setitem__((0, 0), np.inf)),
        (WindowFault.GAP, lambda t, x: t.__setitem__(slice(90, None), t[90:] + 100_000_000)),
        (WindowFault.OUT_OF_ORDER, lambda t, x: t.__setitem__(20, t[19])),
        (WindowFault.OUT_OF_ORDER, lambda t, x: t.__setitem__(20, t[10])),
        (WindowFault.RATE, lambda t, x: t.__setitem__(slice(None), t[0] + 4 * (t - t[0]))),
        (WindowFault.REPEATED, lambda t, x: x.__setitem__(slice(50, 70), x[50])),
        (WindowFault.SATURATED, lambda t, x: np.clip(x, -0.05, 0.08, out=x)),
    ],
)
def test_faults_are_named(fault, spoil):
    t_ns, readings = stamped()
    spoil(t_ns, readings)
    assert find_fault(t_ns, readings, RATES) is fault
    assert fault.value


def test_a_coarse_still_gyroscope_is_quantised_but_not_faulty():
    t_ns, readings = stamped()
    readings[:, 3:] = np.round(readings[:, 3:] / 0.1) * 0.1
    readings[:, 5] = 0.0
    assert find_fault(t_ns, readings, RATES) is None
    assert quantisation_step(readings) == pytest.approx([0, 0, 0, 0.1, 0.1, 0.0])


def test_slow_quantised_motion_dwells_at_its_peaks_but_is_not_saturated():
    t_ns, readings = stamped()
    wave = np.sin(2 * np.pi * np.arange(200) / 200.0)
    readings[:, 4] = np.round(wave / 0.01) * 0.01
    assert np.sum(readings[:, 4] == readings[:, 4].max()) > 5
    assert find_fault(t_ns, readings, RATES) is None
    readings[:, 4] = np.clip(wave, -0.7, 0.7)
    assert find_fault(t_ns, readings, RATES) is WindowFault.SATURATED


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_resolution_is_read_off_the_values(dtype):
    _, readings = stamped()
    step = 9.81 / 2048
    coarse = (np.round((readings + 9.81) / step) * step).astype(dtype).astype(float)
    assert quantisation_step(coarse) == pytest.approx(np.full(6, step), rel=1e-2)
    assert (quantisation_step(readings) == 0.0).all()


def test_oversize_limit_leaves_room_for_models():
    assert PLATEAU.stat().st_size < onnx_model.LARGEST_MODEL_BYTES / 4
