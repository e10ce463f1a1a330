"""
Train a noise regressor; write the ONNX file and its model card.

One run makes everything from a seed: data, training, `NAME.onnx`, `NAME.md`. The same seed on the
same machine gives the same file, also when the run was interrupted and resumed.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

try:
    import onnx
    import torch
    from torch import Tensor, nn
except ImportError as missing:
    print(f"tools.regressor.train: error: {missing}: run tools/setup.sh train", file=sys.stderr)
    raise SystemExit(2) from None
import numpy as np
from tqdm import tqdm

from hybrid_ins.cli import options, program
from hybrid_ins.errors import InputError
from hybrid_ins.noise_regressor.models import NoiseRegressor, Regressor, SpectralRegressor
from hybrid_ins.noise_regressor.onnx_model import FORMAT
from tools.regressor import model_card, networks, noise_data, noise_randomised

TRACK_RATE_HZ = 100.0

Loss = Callable[[Sequence[Tensor]], Tensor]

PAPER_TEXT = """\
The regressor of Or & Klein, "A Hybrid Model and Learning-Based Adaptive Navigation Filter" (IEEE
TIM 2022, section III-C), rebuilt: three one-dimensional convolutions (5 filters of 20, 3 of 10, 3
of 5), leaky ReLU 0.01, layer normalisation over (channel, length), global average pooling, linear
layers 100-80-50-20-1. Trained as in the paper: Adam 1e-3, batches of 500, 30 epochs, rate x 0.1
after 20, squared error, 80 % of its data set drawn at random.

Input: one channel's raw window a row, float32 (channels, window) in m/s² or rad/s. Output: noise
variance of one sample, in those units squared.

**Limits.** It was trained on q from 0.001 to 0.025, white noise and the paper's motion; outside
this range it is wrong by orders of magnitude (tables below). It is the baseline for comparison;
use the plateau model. In the rows "trajectory" the noise is new, the motion is that of the
training."""

SPECTRAL_TEXT = """\
`hybrid_ins.noise_regressor.models.SpectralRegressor`: the plateau of
`hybrid_ins.core.noise.spectral`, used where no model file can be used. It needs no model file and
no training: it removes the cubic trend and the slowest tenth of the DCT modes, and averages the
blocks of modes that agree with the low end, or, where that end falls steeply as motion does, with
the floor above it.

**Limits.** Strong and fast motion (more than about 0.3 cycles/sample at many sigma) leaves no
floor; a single outlier or step raises all modes."""

PLATEAU_TEXT = """\
Estimates the low-frequency plateau of a channel's noise, as the variance per sample of the white
noise with that plateau, at the window's end. This is what navigation integrates. For white noise
it is the variance. Vibration tones, steps, manoeuvres and bias are ignored.

Inside the graph: centre, divide by the largest magnitude, energies of fixed unit-gain bands (DCT
under two tapers and three trend removals, the window's last half and quarter, differences over
tenths of it), and a small network that receives only ratios of these energies and returns their
weights and one factor. So the model is invariant to an offset and equivariant to the scale,
whatever its weights are.

Input: one channel's raw window a row, float32 (channels, window) in any unit. Output: variance of
one sample in that unit squared. Subtract its mean in double precision before: float32 cannot hold
small noise on it.

Trained on synthetic windows only (`tools.regressor.noise_randomised.randomised_set`), never on the
paper's set: 100-1000 Hz, motion, rough ground, manoeuvres, tones, coloured noise, switching levels,
outliers, repeated samples, clipping, quantisation.

**Limits.** Noise cannot be separated where motion and vibration leave no gap in the spectrum:
pulse trains (an engine's strokes), jumps every few samples and strong random resonances are taken
for noise, which makes the filter cautious (tables below). Noise that falls by more than about 20 dB
from its plateau to a floor, as of a driver that smooths twice, is taken for motion. Repeated
samples are removed: the estimate is that of the readings before repetition. A window that ends less
than about 20 samples after a change of level shows the old level. The result must not be below
LSB²/12. It does not know the rate, and is used from 25 Hz on. Below 100 Hz the turns of an agile
vehicle, or of a body on rough ground, fill the band of its gyroscopes and are taken for their
noise: there hybrid_ins uses the constant noise.q_gyroscope."""


TEXTS = {"plateau": PLATEAU_TEXT, "paper": PAPER_TEXT, "spectral": SPECTRAL_TEXT}
SLOWEST_HZ = 25.0
"""The plateau network does not know the rate: from there on it was tried (docs/regressor.md)."""
RATES_HZ = {"plateau": (SLOWEST_HZ, noise_data.RATE_RANGE_HZ[1]), "paper": noise_data.RATE_RANGE_HZ}
SHORTEST = {"plateau": 100, "paper": 50, "spectral": 100}  # samples in a window


class Recipe(NamedTuple):
    """What training needs to know."""

    network: nn.Module
    inputs: tuple[Tensor, ...]
    loss: Loss
    batch: int
    epochs: int
    rates: Callable[[float], float]
    """Learning rate after so many epochs."""


def paper_recipe(args: argparse.Namespace, data: noise_data.Windows) -> Recipe:
    """Return the paper's recipe on the given training windows."""
    network = networks.PaperNet(args.window)
    # In units of 0.01, which Adam does not see but single precision does.
    labels = torch.from_numpy(data.variance.astype(np.float32))

    def loss(batch: Sequence[Tensor]) -> Tensor:
        readings, variance = batch
        return ((network(readings) - variance) * 100.0).square().mean()

    epochs = args.epochs or (2 if args.quick else 30)
    readings = torch.from_numpy(data.readings)
    return Recipe(
        network, (readings, labels), loss, 500, epochs, lambda epoch: 1e-3 if epoch < 20 else 1e-4
    )


def plateau_recipe(args: argparse.Namespace, backgrounds: np.ndarray | None) -> Recipe:
    """Return our recipe: energies computed once, errors of log q in the network's own scale."""
    network = networks.PlateauNet(args.window)
    # Many windows seen few times: a million seen forty times were learned by heart.
    chunk = 4000
    total = -(-(args.windows or (4000 if args.quick else 3_000_000)) // chunk) * chunk
    energies = torch.empty(total, len(network.averages))
    repeats, target = torch.empty(total, 1), torch.empty(total)
    for index in tqdm(range(total // chunk), desc="windows", disable=not sys.stderr.isatty()):
        seed = args.seed * 1_000_003 + index
        data = noise_randomised.randomised_set(seed, chunk, args.window, backgrounds=backgrounds)
        rows = slice(index * chunk, (index + 1) * chunk)
        with torch.no_grad():
            energies[rows], repeats[rows], scale = network.energies(torch.from_numpy(data.readings))
        target[rows] = torch.from_numpy(np.log(data.variance)).float() - 2.0 * torch.log(scale)

    def loss(batch: Sequence[Tensor]) -> Tensor:
        energies, repeats, target = batch
        level, coarse, log_scale = network.log_level(energies, repeats)
        # Errors count relative to what the window allows: 10 % on a clean one weighs as much as a
        # factor of two where motion and vibration cover the floor.
        scale = torch.exp(log_scale).clamp_min(0.02)
        nothing = torch.zeros_like(level)
        miss = nn.functional.huber_loss((level - target) / scale, nothing, delta=1.5)
        guide = nn.functional.huber_loss(coarse, target, delta=0.3)
        return torch.log(scale).mean() + miss + 0.1 * guide

    epochs = args.epochs or (2 if args.quick else 16)

    def rate(epoch: float) -> float:
        return float(3e-3 * 0.5 * (1.0 + np.cos(np.pi * epoch / epochs)) + 1e-5)

    return Recipe(network, (energies, repeats, target), loss, 2000, epochs, rate)


def fit(recipe: Recipe, checkpoint: Path, resume: bool, seed: int) -> None:
    """Train in place; the state after each epoch is kept in `checkpoint` until the end."""
    optimiser = torch.optim.Adam(recipe.network.parameters())
    first = 0
    run = {"seed": seed, "windows": len(recipe.inputs[0]), "epochs": recipe.epochs}
    if resume and checkpoint.is_file():
        saved = torch.load(checkpoint, weights_only=True)
        if saved["run"] != run:
            raise InputError(f"{checkpoint}: of another run ({saved['run']}); drop --resume")
        recipe.network.load_state_dict(saved["network"])
        optimiser.load_state_dict(saved["optimiser"])
        first = int(saved["epoch"])
    size = len(recipe.inputs[0])
    progress = tqdm(range(first, recipe.epochs), desc="epochs", disable=not sys.stderr.isatty())
    for epoch in progress:
        # The order depends on seed and epoch alone, so that a resumed run is the same run.
        order = np.random.default_rng((seed, epoch)).permutation(size)
        losses = []
        for start in range(0, size, recipe.batch):
            for group in optimiser.param_groups:
                group["lr"] = recipe.rates(epoch + start / size)
            rows = torch.from_numpy(order[start : start + recipe.batch])
            loss = recipe.loss([column[rows] for column in recipe.inputs])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            losses.append(loss.detach())
        progress.set_postfix(loss=f"{torch.stack(losses).mean().item():.3e}")
        torch.save(
            {
                "network": recipe.network.state_dict(),
                "optimiser": optimiser.state_dict(),
                "epoch": epoch + 1,
                "run": run,
            },
            checkpoint,
        )


def background_windows(bags: Sequence[str], topic: str, window: int) -> np.ndarray | None:
    """Return windows (M, N) of the recordings' IMU channels, half overlapping."""
    if not bags:
        return None
    # Only here: training without recordings needs no bag reader.
    from hybrid_ins.bags.reader import BagReader

    rows: list[np.ndarray] = []
    for path in bags:
        with BagReader(path) as bag:
            imu = bag.imu(topic)
        readings = np.hstack((imu.specific_force, imu.angular_rate))
        for start in range(0, len(readings) - window + 1, window // 2):
            piece = readings[start : start + window].T
            rows.extend(row for row in piece if np.isfinite(row).all() and np.ptp(row) > 0.0)
        if not rows:
            raise InputError(f"{path}: no window of {window} IMU samples on {topic}")
    return np.asarray(rows, dtype=np.float32)


def export(network: nn.Module, path: Path, args: argparse.Namespace) -> None:
    """Write the trained network as a model that `Regressor.load` accepts."""
    low, high = RATES_HZ[args.model]
    declared = {
        "format": FORMAT,
        "name": path.stem,
        "window": str(args.window),
        "rate_min": f"{low:g}",
        "rate_max": f"{high:g}",
        "centred": "0" if args.model == "paper" else "1",
        "input": "one channel a row, m/s^2 or rad/s, oldest sample first",
        "output": f"{'variance' if args.model == 'paper' else 'plateau'} per sample",
        "seed": str(args.seed),
    }
    metadata = {f"hybrid_ins.{key}": value for key, value in declared.items()}
    if isinstance(network, networks.PaperNet):
        model = networks.onnx_paper(network, metadata)
    else:
        assert isinstance(network, networks.PlateauNet)
        model = networks.onnx_plateau(network, metadata)
    onnx.save(model, path)


def paper_data(args: argparse.Namespace) -> tuple[noise_data.Windows, noise_data.Windows]:
    """Return training and test windows: of the paper's trajectories, or of one's own."""
    if args.tracks:
        # Only here: training without recordings needs no bag reader.
        from tools.regressor.tracks import track_readings

        parts = [part for bag in args.tracks for part in track_readings(bag, TRACK_RATE_HZ)]
        own = noise_data.noisy_windows(args.seed, dict(enumerate(parts)), args.window)
        return noise_data.random_split(own, args.seed)
    duration = 8.0 if args.quick else noise_data.PAPER_DURATION_S
    data = noise_data.paper_set(args.seed, args.window, duration_s=duration)
    return noise_data.random_split(data, args.seed)


def leave_one_out(
    args: argparse.Namespace, data: noise_data.Windows, path: Path
) -> list[model_card.Row]:
    """Train the paper's network once without each trajectory and score it on that one."""
    rows: list[model_card.Row] = []
    for index, name in enumerate(noise_data.PAPER_TRAJECTORIES):
        others, unseen = noise_data.trajectory_split(data, index)
        torch.manual_seed(args.seed)
        recipe = paper_recipe(args, others)
        part = path.with_name(f"{path.stem}.without_{index}.onnx")
        checkpoint = part.with_suffix(".checkpoint.pt")
        fit(recipe, checkpoint, args.resume, args.seed)
        export(recipe.network, part, args)
        rows.append((f"{name}, trained on the other five", Regressor.load(part), unseen))
        part.unlink()
        checkpoint.unlink()
    return rows


def train(args: argparse.Namespace) -> int:
    """Do what the command line asks for."""
    torch.set_num_threads(args.threads)
    torch.use_deterministic_algorithms(True)
    torch.manual_seed(args.seed)
    path = Path(args.out) / f"{args.name or args.model}.onnx"
    path.parent.mkdir(parents=True, exist_ok=True)
    checkpoint = path.with_suffix(".checkpoint.pt")
    test, unseen = None, []
    if args.model == "paper":
        data, test = paper_data(args)
        if args.leave_one_out:
            unseen = leave_one_out(args, data, path)
    if args.model != "spectral" and not args.card_only:
        if args.model == "paper":
            recipe = paper_recipe(args, data)
        else:
            backgrounds = background_windows(args.background, args.topic, args.window)
            recipe = plateau_recipe(args, backgrounds)
        fit(recipe, checkpoint, args.resume, args.seed)
        export(recipe.network, path, args)
        checkpoint.unlink(missing_ok=True)
    regressor: NoiseRegressor
    if args.tracks and test is not None:
        unseen, test = [("own tracks, random fifth", Regressor.load(path), test)], None
    if args.model == "spectral":
        regressor, title = SpectralRegressor(args.window), "spectral"
    else:
        regressor, title = Regressor.load(path), path.name
    model_card.write_card(
        path.with_suffix(".md"),
        regressor,
        title=title,
        text=TEXTS[args.model],
        command=_command(args),
        paper_test=test,
        unseen=unseen,
        quick=args.quick,
    )
    print(path.with_suffix(".md"))
    return 0


def _command(args: argparse.Namespace) -> str:
    """Return the command to write in the card: choices, but no path of this machine."""
    words = ["python -m tools.regressor.train", f"--model {args.model}", f"--seed {args.seed}"]
    for option in ("window", "windows", "epochs"):
        value = getattr(args, option)
        if value and value != _parser().get_default(option):
            words.append(f"--{option} {value}")
    for switch in ("leave_one_out", "quick"):
        if getattr(args, switch):
            words.append("--" + switch.replace("_", "-"))
    for option, bags in (("--background", args.background), ("--tracks", args.tracks)):
        if bags:
            words.append(f"{option} " + " ".join(Path(bag).name for bag in bags))
    return " ".join(words)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m tools.regressor.train",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="""\
examples:
  python -m tools.regressor.train --model plateau
  python -m tools.regressor.train --model plateau --name my_robot --background flight1.mcap drive2/
  python -m tools.regressor.train --model paper --name my_robot --tracks smoothed.mcap
needs: tools/setup.sh train""",
    )
    parser.add_argument("--model", choices=tuple(TEXTS), required=True)
    parser.add_argument("--name", help="name of the files (default: as --model)")
    parser.add_argument("--out", default="models", help="folder to write to (default: models)")
    parser.add_argument("--seed", type=options.count, default=1, help="[1]")
    parser.add_argument(
        "--window", type=options.count, default=200, help="samples N in a window [200]"
    )
    parser.add_argument(
        "--windows", type=options.count, help="windows to train on (plateau) [3000000]"
    )
    parser.add_argument("--epochs", type=options.count, help="[16 plateau, 30 paper]")
    parser.add_argument("--threads", type=options.count, default=1, help="[1]")
    parser.add_argument(
        "--leave-one-out",
        action="store_true",
        help="train six more times, each without one trajectory, for the card (paper)",
    )
    parser.add_argument("--quick", action="store_true", help="a few seconds, to see that it works")
    parser.add_argument(
        "--card-only", action="store_true", help="score the model file that is there, train nothing"
    )
    parser.add_argument("--resume", action="store_true", help="go on from the last epoch kept")
    parser.add_argument(
        "--background",
        nargs="+",
        default=[],
        metavar="BAG",
        help="recordings whose motion and vibration to train on (plateau)",
    )
    parser.add_argument(
        "--tracks",
        nargs="+",
        type=Path,
        default=[],
        metavar="BAG",
        help="smoothed runs (ins_replay --smooth) in place of the paper's trajectories (paper)",
    )
    parser.add_argument("--topic", default="/imu/data", help="IMU topic in the recordings")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program."""
    args = _parser().parse_args(argv)
    if args.model != "plateau" and args.background:
        _parser().error("--background is for --model plateau")
    if args.tracks and (args.model != "paper" or args.leave_one_out):
        _parser().error("--tracks is for --model paper without --leave-one-out")
    if args.window < SHORTEST[args.model]:
        _parser().error(f"--window: --model {args.model} needs {SHORTEST[args.model]} samples")
    if args.threads < 1:
        _parser().error("--threads: at least 1")
    return program.run(train, args)


if __name__ == "__main__":
    sys.exit(main())
