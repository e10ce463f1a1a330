"""
Train the network for the variance of the non-holonomic constraint; write its ONNX file and card.

It learns from simulated cars on random roads: what one second of IMU samples shows of how far the
rear axle slips and heaves. Odd seeds train, even seeds judge. The same seed on the same machine
gives the same file.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

try:
    import onnx
    import torch
    from torch import Tensor
except ImportError as missing:
    print(
        f"tools.regressor.train_slip: error: {missing}: run tools/setup.sh train", file=sys.stderr
    )
    raise SystemExit(2) from None
import numpy as np

from hybrid_ins.cli import options, program
from hybrid_ins.core.constraints.constraint_observer import SLIP_TIME
from hybrid_ins.noise_regressor.onnx_model import FORMAT
from hybrid_ins.ros.messages.trajectory import Array
from tools.regressor import slip_data
from tools.regressor.slip_network import SlipNet, features_of, onnx_slip

TOGETHER = 8  # consecutive windows: four seconds
BATCH, EPOCHS = 500 // TOGETHER, 40
WEIGHT_DECAY = 1e-5
TRAINING, JUDGING = 1001, 2002  # first seeds
DRIVES, CHANGING = 240, 80  # on random roads, on roads that change
SMALLEST = 0.005  # m/s, of slip: none is known better, and a vehicle that stands has none at all
SHARE_THAT_JUDGES = 6  # one for so many that train

TEXT = """\
How far the rear axle of a vehicle on wheels slips and heaves now: variances of its velocity to the
right and down, read from the last second of specific force and angular rate. They are the
covariance of the non-holonomic constraint in outages (`vehicle.slip_model`). Vibration shows the
road, and the road makes the axle heave and wander. What the observer of the constraint takes out
itself is not part of it: the place of the point without slip, which tyres that slip out of turns
displace, and the pitch of the body by its acceleration.

Input: float32 (6, samples), forward, right, down in m/s² and rad/s, one second, a multiple of ten
samples. Output: float32 (2,), (m/s)². The features are part of the graph: spreads of the means of
tenths of the window, within them, and of their sum; the step between its halves; how sharp the turn
is; all as logarithms, limited to the range of the training. Two hidden layers of 32, tanh. The loss
is the likelihood of the true velocity and of its sums over 1, 2 and 4 s, with the correlation time
of 0.3 s with which the constraint counts.

**Limits.** It has seen simulated cars only: a town's streets at up to 15 m/s, an IMU of the grade
of an MPU-9250 whose vibration grows with the roughness of the road (to a factor of 1.6, one sigma),
no trucks, no trailers, no snow. The reader limits its answers to 0.1 to 10 times
`vehicle.slip_std`, and refuses windows with gaps, repeated samples, saturation, or a rate beyond 50
to 200 Hz."""


def likelihood(log_variance: Tensor, slip: Tensor) -> Tensor:
    """Return the negative logarithm of the likelihood of slip (..., 2), but for a constant."""
    return 0.5 * (log_variance + (slip.square() + SMALLEST**2) * torch.exp(-log_variance))


def lasting(log_variance: Tensor, slip: Tensor) -> Tensor:
    """
    Return the same of the slip of consecutive windows (B, N, 2), and of the sums of 2, 4, ... N.

    Slip has the correlation time with which the constraint counts. What is as often to the left as
    to the right within seconds hardly moves a position, and what is not does.
    """
    decay = float(np.exp(-slip_data.BETWEEN / SLIP_TIME))
    total, length = 0.0 * likelihood(log_variance, slip).mean(), 1
    while length <= slip.shape[1]:
        factor = 1.0 + 2.0 * sum((1.0 - k / length) * decay**k for k in range(1, length))
        variance = torch.exp(log_variance).unflatten(1, (-1, length)).sum(dim=2) * factor
        sums = slip.unflatten(1, (-1, length)).sum(dim=2)
        total, length = total + likelihood(torch.log(variance), sums).mean(), 2 * length
    return total


def columns(drives: Iterable[slip_data.Drive]) -> tuple[Tensor, Tensor]:
    """Return features (B, TOGETHER, F) and slip (B, TOGETHER, 2) of drives."""
    features, slip = [], []
    for readings, velocity in drives:
        size = len(velocity) - len(velocity) % TOGETHER
        found = features_of(torch.from_numpy(readings[:size]).float())
        features.append(found.unflatten(0, (-1, TOGETHER)))
        slip.append(torch.from_numpy(velocity[:size]).float().unflatten(0, (-1, TOGETHER)))
    return torch.cat(features), torch.cat(slip)


def fit(features: Tensor, slip: Tensor, seed: int, epochs: int) -> SlipNet:
    """Return the trained network."""
    torch.manual_seed(seed)
    base = torch.log(slip.square().mean(dim=(0, 1)))
    flat = features.flatten(0, 1)
    network = SlipNet(flat.mean(dim=0), flat.std(dim=0), base)
    optimiser = torch.optim.Adam(network.parameters(), weight_decay=WEIGHT_DECAY)
    for epoch in range(epochs):
        for group in optimiser.param_groups:
            group["lr"] = 1e-3 * (1.0 + np.cos(np.pi * epoch / epochs)) + 1e-5
        order = torch.randperm(len(features))
        for rows in order.split(BATCH):
            loss = lasting(network.log_variance(features[rows]), slip[rows])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
    return network


def export(network: SlipNet, path: Path, seed: int) -> None:
    """Write the trained network as a model that `SlipRegressor.load` accepts."""
    declared = {
        "format": FORMAT,
        "name": path.stem,
        "duration": "1",
        "rate_min": f"{min(slip_data.RATES_HZ):g}",
        "rate_max": f"{max(slip_data.RATES_HZ):g}",
        "input": "forward, right, down: m/s^2, then rad/s; oldest sample first",
        "output": "variance of the velocity to the right and down, (m/s)^2",
        "seed": str(seed),
    }
    metadata = {f"hybrid_ins.{key}": value for key, value in declared.items()}
    onnx.save(onnx_slip(network, metadata), path)


def figures(network: SlipNet, features: Tensor, slip: Tensor) -> Array:
    """
    Return what the network is worth on windows that it has not seen, (3, 2).

    Gain of the logarithm of the likelihood [nats per window] against the constant of the training;
    against the best constant in hindsight; mean of (slip / σ)².
    """
    with torch.no_grad():
        slip = slip.flatten(0, 1)
        log_variance = network.log_variance(features.flatten(0, 1))
        ours = likelihood(log_variance, slip).mean(dim=0)
        constant = likelihood(network.base.expand_as(slip), slip).mean(dim=0)
        best = 0.5 * (torch.log(slip.square().mean(dim=0)) + 1.0)
        nees = (slip.square() * torch.exp(-log_variance)).mean(dim=0)
    return torch.stack((constant - ours, best - ours, nees)).numpy()


def card(path: Path, command: str, rows: Sequence[tuple[str, Array]]) -> None:
    """Write the model card."""
    lines = [
        "| drives of even seeds | gain on the training's constant | on the best constant in "
        "hindsight | mean (slip / σ)² |",
        "|---|---|---|---|",
    ]
    for name, found in rows:
        cells = (f"{right:.2f}, {down:.2f}" for right, down in found)
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    parts = (
        f"# {path.stem}.onnx",
        TEXT,
        f"Made by `{command}`.",
        "## Figures",
        "To the right, down. Gains are those of the log-likelihood, in nats per window. What that "
        "is worth in outages: [Outages of GNSS](../docs/outages.md).",
        "\n".join(lines),
    )
    path.write_text("\n\n".join(parts) + "\n", encoding="utf-8")


def train(args: argparse.Namespace) -> int:
    """Do what the command line asks for."""
    torch.set_num_threads(1)
    torch.use_deterministic_algorithms(True)
    part = 40 if args.quick else 1
    counts = DRIVES // part, CHANGING // part
    seeds = [range(TRAINING, TRAINING + 2 * count, 2) for count in counts]
    network = fit(*columns(slip_data.drives(*seeds)), args.seed, 2 if args.quick else EPOCHS)
    path = Path(args.out) / f"{args.name}.onnx"
    path.parent.mkdir(parents=True, exist_ok=True)
    export(network, path, args.seed)
    count = max(DRIVES // SHARE_THAT_JUDGES // part, 1)
    judging = range(JUDGING, JUDGING + 2 * count, 2)
    rows = [
        ("random roads", figures(network, *columns(slip_data.drives(judging, [])))),
        ("roads that change", figures(network, *columns(slip_data.drives([], judging)))),
    ]
    command = "python -m tools.regressor.train_slip" + " --quick" * args.quick
    card(path.with_suffix(".md"), command, rows)
    print(path.with_suffix(".md"))
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.regressor.train_slip",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="needs: tools/setup.sh train",
    )
    parser.add_argument("--name", default="slip", help="name of the files [slip]")
    parser.add_argument("--out", default="models", help="folder to write to (default: models)")
    parser.add_argument("--seed", type=options.count, default=1, help="[1]")
    parser.add_argument("--quick", action="store_true", help="a few seconds, to see that it works")
    return program.run(train, parser.parse_args(argv))


if __name__ == "__main__":
    sys.exit(main())
