"""Training: the network of the paper, the graph that is written, the same file every time."""

import numpy as np
import pytest

pytest.importorskip("torch", reason="training needs torch: run tools/test.sh all")
pytest.importorskip("onnx", reason="training needs onnx: run tools/test.sh all")

import onnx
import torch

from hybrid_ins.bags.messages import new_message
from hybrid_ins.bags.reader import BagReader
from hybrid_ins.bags.writer import BagWriter
from hybrid_ins.cli import replay, simulate
from hybrid_ins.errors import InputError
from hybrid_ins.noise_regressor.models import Regressor
from hybrid_ins.noise_regressor.slip import SlipRegressor
from tools.regressor import networks, slip_network, train_slip
from tools.regressor import train as training
from tools.regressor.tracks import track_readings


def white(variance: float) -> np.ndarray:
    return np.random.default_rng(0).normal(0.0, np.sqrt(variance), (6, 200))


def test_paper_network_is_what_the_paper_describes():
    network = networks.PaperNet()
    shapes = [tuple(layer.weight.shape) for layer in network.convolutions]
    assert shapes == [(5, 1, 20), (3, 5, 10), (3, 3, 5)]
    assert [layer.out_features for layer in network.layers] == [100, 80, 50, 20, 1]
    # Layer normalisation over (channel, length): each window's feature map has mean 0, variance 1.
    feature = torch.randn(4, 5, 181)
    expected = torch.nn.functional.layer_norm(feature, (5, 181), eps=network.EPSILON)
    mean = feature.mean(dim=(1, 2), keepdim=True)
    variance = (feature - mean).square().mean(dim=(1, 2), keepdim=True)
    assert torch.allclose(
        (feature - mean) / (variance + network.EPSILON).sqrt(), expected, atol=1e-5
    )


def test_bands_have_unit_gain_and_no_response_to_a_constant():
    projections, averages = networks.plateau_analysis(200)
    assert np.abs(projections.sum(axis=1)).max() < 1e-5
    assert np.linalg.norm(projections, axis=1) == pytest.approx(1.0, abs=1e-5)
    assert averages.sum(axis=1) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("name", ["PaperNet", "PlateauNet"])
def test_onnx_graph_is_the_torch_module(tmp_path, name):
    torch.manual_seed(0)
    network = getattr(networks, name)()
    metadata = {
        "format": "1",
        "name": "x",
        "window": "200",
        "rate_min": "100",
        "rate_max": "1000",
        "centred": "0",
    }
    export = networks.onnx_paper if name == "PaperNet" else (networks.onnx_plateau)
    with torch.no_grad():
        for layer in network.modules():
            if isinstance(layer, torch.nn.Linear):
                layer.bias.add_(0.1)
    model = export(network, {f"hybrid_ins.{key}": value for key, value in metadata.items()})
    onnx.save(model, tmp_path / "x.onnx")
    window = (white(0.3) + np.linspace(0, 5, 200)).astype(np.float32)
    window[2, 50:90] = window[2, 50]
    with torch.no_grad():
        expected = network(torch.from_numpy(window)).numpy()
    found = Regressor.load(tmp_path / "x.onnx").estimate(window, 100.0)
    assert found == pytest.approx(expected, rel=2e-4)


@pytest.mark.parametrize("model", ["plateau", "paper"])
def test_training_is_deterministic_and_resumes(tmp_path, model, monkeypatch):
    """GIVEN a run cut after one epoch WHEN resumed THEN the file is that of an uncut run."""
    options = ["--model", model, "--quick", "--epochs", "3"]
    assert training.main([*options, "--out", str(tmp_path / "one")]) == 0

    keep = torch.save

    def keep_and_stop(*arguments):
        keep(*arguments)
        raise KeyboardInterrupt

    monkeypatch.setattr(torch, "save", keep_and_stop)
    assert training.main([*options, "--out", str(tmp_path / "two")]) == 130
    monkeypatch.setattr(torch, "save", keep)
    assert training.main([*options, "--out", str(tmp_path / "two"), "--resume"]) == 0
    one, two = (tmp_path / folder / f"{model}.onnx" for folder in ("one", "two"))
    assert one.read_bytes() == two.read_bytes()
    card = (tmp_path / "one" / f"{model}.md").read_text()
    for word in (
        "q RMSE",
        "trajectory: agile",
        "q = 1e-06",
        "tone of 100 sigma",
        "30 % duplicates",
        "low-pass at fs/4",
        "bias of 1000",
        "median",
        str(options[1]),
    ):
        assert word in card
    assert str(tmp_path) not in card


def test_backgrounds_are_windows_of_the_recordings(tmp_path):

    with BagWriter(tmp_path / "flight.mcap") as bag:
        for index in range(450):
            message = new_message("sensor_msgs/msg/Imu")
            message.linear_acceleration.x = float(np.sin(0.1 * index))
            message.angular_velocity.z = 0.01 * index
            bag.write("/imu/data", message, index * 10_000_000)
    rows = training.background_windows([str(tmp_path / "flight.mcap")], "/imu/data", 200)
    assert rows.shape == (2 * 3, 200)  # two channels move, three half-overlapping windows
    assert rows[0] == pytest.approx(np.sin(0.1 * np.arange(200)), abs=1e-6)
    with pytest.raises(InputError, match="no window"):
        training.background_windows([str(tmp_path / "flight.mcap")], "/imu/data", 1000)


def test_a_smoothed_track_is_the_truth_for_training_on_ones_own_robot(tmp_path):
    """GIVEN a flight WHEN smoothed and trained on THEN the model gives the filter's noise."""
    flight, smoothed, out = (tmp_path / f"{name}.mcap" for name in ("flight", "smoothed", "out"))
    duration = ["--duration", "40", "--imu-rate", "100", "--seed", "2"]
    assert simulate.main([str(flight), *duration]) == 0
    assert replay.main([str(flight), str(smoothed), "--smooth"]) == 0

    options = ["--model", "paper", "--quick", "--name", "own", "--out", str(tmp_path)]
    assert training.main([*options, "--tracks", str(smoothed)]) == 0

    card = (tmp_path / "own.md").read_text()
    assert "--tracks smoothed.mcap" in card
    assert "own tracks, random fifth" in card
    model = ["-p", f"noise.model:={tmp_path / 'own.onnx'}"]
    assert replay.main([str(flight), str(out), *model]) == 0
    with BagReader(out) as bag:
        statuses = [s for _, _, m in bag.messages("/diagnostics") for s in m.status]
    assert any(value.value == "learned" for s in statuses for value in s.values)


def test_readings_of_a_smoothed_track_are_those_of_the_motion(tmp_path):
    flight, smoothed = tmp_path / "flight.mcap", tmp_path / "smoothed.mcap"
    duration = ["--duration", "40", "--imu-rate", "100", "--seed", "2"]
    assert simulate.main([str(flight), *duration]) == 0
    assert replay.main([str(flight), str(smoothed), "--smooth"]) == 0
    with BagReader(flight) as bag:
        imu = bag.imu()
    true = np.hstack((imu.specific_force, imu.angular_rate))

    (readings,) = track_readings(smoothed, 100.0)

    first = len(true) - len(readings) - 1
    own, true = readings[100:-100], true[first + 100 : first + len(readings) - 100]
    for column in range(6):
        assert np.corrcoef(own[:, column], true[:, column])[0, 1] > 0.9
    # The noise is gone: third differences show it alone.
    noise = np.diff(true, n=3, axis=0).std(axis=0)
    assert np.all(np.diff(own, n=3, axis=0).std(axis=0) < 0.2 * noise)


def test_a_checkpoint_of_another_run_is_refused(tmp_path):
    torch.save({"run": {"seed": 7}}, tmp_path / "plateau.checkpoint.pt")
    options = ["--model", "plateau", "--quick", "--resume", "--out", str(tmp_path)]
    assert training.main(options) == 2


def test_the_graph_for_the_slip_is_the_torch_module(tmp_path):
    torch.manual_seed(0)
    readings = torch.randn(8, 6, 100) * torch.tensor([0.3] * 3 + [0.01] * 3)[:, None]
    readings[:, 2] -= 9.8
    features = slip_network.features_of(readings)
    base = torch.tensor([-5.0, -4.0])
    network = slip_network.SlipNet(features.mean(0), features.std(0), base)
    train_slip.export(network, tmp_path / "x.onnx", 1)
    model = SlipRegressor.load(tmp_path / "x.onnx")

    for size in (50, 100, 200):
        wild = 30.0 * torch.randn(6, size)  # far beyond the training: limited
        for window in (readings[0, :, :50].repeat(1, size // 50), wild):
            with torch.no_grad():
                expected = network(window[None])[0].numpy()
            assert model.estimate(window.numpy()) == pytest.approx(expected, rel=1e-3)


def test_slip_that_cancels_within_seconds_counts_for_less_than_slip_that_lasts():
    """The best constant variance of both is that of the slip but for what its sums say."""
    torch.manual_seed(0)
    white = 0.1 * torch.randn(4000, train_slip.TOGETHER, 2)
    lasts = white[:, :1].expand_as(white)

    def best(slip):
        variances = 0.01 * 2.0 ** torch.arange(-4.0, 5.0, 0.125)
        losses = [
            float(train_slip.lasting(torch.full_like(slip, float(torch.log(v))), slip))
            for v in variances
        ]
        return float(variances[int(np.argmin(losses))])

    alternating = white.abs() * torch.tensor([1.0, -1.0]).repeat(train_slip.TOGETHER // 2)[:, None]
    assert best(lasts) > 2.0 * best(white)
    assert best(alternating) < 0.8 * best(white)
    assert best(white) == pytest.approx(0.01, rel=0.3)


def test_training_for_the_slip_is_deterministic(tmp_path):
    for name in ("one", "two"):
        assert train_slip.main(["--quick", "--out", str(tmp_path / name)]) == 0
    first, second = (tmp_path / name / "slip.onnx" for name in ("one", "two"))
    assert first.read_bytes() == second.read_bytes()
    assert "--quick" in (tmp_path / "one" / "slip.md").read_text()
