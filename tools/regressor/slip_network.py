"""The network for the variance of the non-holonomic constraint, and the same graph as ONNX."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import onnx
import torch
from torch import Tensor, nn

from tools.regressor.networks import Graph

PARTS = 10  # of the window
CHANNELS = 6
SMALLEST = 1e-4  # m/s², rad/s: added to spreads before their logarithm
TURNING = (1, 5)  # channels whose means show a turn: force to the right, rate about down
TURNING_FLOORS = (0.05, 0.005)  # m/s², rad/s
SIDE_FLOOR = 1e-3  # m/s³
WIDEST = 4.0  # standard deviations of the training set: what is beyond counts as that


class SlipNet(nn.Module):
    """
    One second of readings in, variances of the velocity to the right and down out.

    The window is divided into tenths. Features are logarithms: the spread of the means of the
    tenths, that within them, that of their cumulated sum (a velocity), the step from the first half
    to the second, and how sharp the turn is. They are limited to the range of the training set.

    Parameters
    ----------
    mean, std : Tensor, shape (F,)
        Of the features of the training set.
    base : Tensor, shape (2,)
        Logarithm of the best constant variances.
    hidden : int
        Width of both hidden layers.
    """

    def __init__(self, mean: Tensor, std: Tensor, base: Tensor, hidden: int = 32) -> None:
        super().__init__()
        self.mean: Tensor
        self.std: Tensor
        self.base: Tensor
        self.register_buffer("mean", mean)
        self.register_buffer("std", std)
        self.register_buffer("base", base)
        self.first = nn.Linear(len(mean), hidden)
        self.second = nn.Linear(hidden, hidden)
        self.last = nn.Linear(hidden, 2)

    def log_variance(self, features: Tensor) -> Tensor:
        """Return log variances (B, 2) for features (B, F)."""
        x = ((features - self.mean) / self.std).clamp(-WIDEST, WIDEST)
        x = torch.tanh(self.second(torch.tanh(self.first(x))))
        return self.base + self.last(x)

    def forward(self, readings: Tensor) -> Tensor:
        """Return variances (B, 2) of windows (B, 6, N), N a multiple of ten."""
        return torch.exp(self.log_variance(features_of(readings)))


def features_of(readings: Tensor) -> Tensor:
    """Return the features (B, F) of windows (B, 6, N), N a multiple of ten."""
    count = len(readings)
    tenths = readings.reshape(count, CHANNELS, PARTS, -1)
    means = tenths.mean(dim=3)
    within = (tenths - means[..., None]).square().mean(dim=(2, 3)).sqrt()
    mean = means.mean(dim=2)
    centred = means - mean[..., None]
    summed = centred @ torch.triu(torch.ones(PARTS, PARTS))
    summed = summed - summed.mean(dim=2, keepdim=True)
    step = (centred @ _halves()).abs()[..., 0]
    force, rate = (mean[:, channel].abs() for channel in TURNING)
    spreads = (
        centred.square().mean(dim=2).sqrt(),
        within,
        summed.square().mean(dim=2).sqrt(),
        step,
    )
    sharp = (force + TURNING_FLOORS[0], rate + TURNING_FLOORS[1], force * rate + SIDE_FLOOR)
    return torch.cat(
        (*(torch.log(spread + SMALLEST) for spread in spreads), torch.log(torch.stack(sharp, 1))),
        dim=1,
    )


def _halves() -> Tensor:
    """Return the weights (10, 1) of the mean of the second half less that of the first."""
    half = PARTS // 2
    return torch.tensor([[-1.0 / half]] * half + [[1.0 / half]] * half)


def onnx_slip(network: SlipNet, metadata: Mapping[str, str]) -> onnx.ModelProto:
    """Return the trained network as an ONNX model: features included."""
    graph = Graph()
    tenths = graph.add("Reshape", "window", graph.constant([CHANNELS, PARTS, -1], np.int64))
    means = graph.add("ReduceMean", tenths, axes=[2], keepdims=1)
    part = graph.add("Sub", tenths, means)
    means = graph.add("Squeeze", means, graph.constant([2], np.int64))
    mean = graph.add("ReduceMean", means, axes=[1], keepdims=1)
    centred = graph.add("Sub", means, mean)
    summed = graph.add("MatMul", centred, graph.constant(np.triu(np.ones((PARTS, PARTS)))))
    summed = graph.add("Sub", summed, graph.add("ReduceMean", summed, axes=[1], keepdims=1))
    step = graph.add("Abs", graph.add("MatMul", centred, graph.tensor(_halves())))

    def spread(x: str, axes: list[int]) -> str:
        square = graph.add("ReduceMean", graph.add("Mul", x, x), axes=axes, keepdims=0)
        return graph.add("Sqrt", square)

    step = graph.add("Squeeze", step, graph.constant([1], np.int64))
    spreads = (spread(centred, [1]), spread(part, [1, 2]), spread(summed, [1]), step)
    smallest = graph.constant(SMALLEST)
    mean = graph.add("Abs", graph.add("Squeeze", mean, graph.constant([1], np.int64)))
    force, rate = (
        graph.add("Gather", mean, graph.constant([channel], np.int64)) for channel in TURNING
    )
    side = graph.add("Add", graph.add("Mul", force, rate), graph.constant(SIDE_FLOOR))
    sharp = [
        graph.add("Add", x, graph.constant(floor))
        for x, floor in zip((force, rate), TURNING_FLOORS, strict=True)
    ]
    x = graph.add("Concat", *(graph.add("Add", x, smallest) for x in spreads), *sharp, side, axis=0)
    x = graph.add("Sub", graph.add("Log", x), graph.tensor(network.mean))
    x = graph.add("Div", x, graph.tensor(network.std))
    x = graph.add("Clip", x, graph.constant(-WIDEST), graph.constant(WIDEST))
    x = graph.add("Unsqueeze", x, graph.constant([0], np.int64))
    x = graph.add("Tanh", graph.linear(x, network.first))
    x = graph.add("Tanh", graph.linear(x, network.second))
    x = graph.add("Add", graph.linear(x, network.last), graph.tensor(network.base))
    graph.add("Squeeze", graph.add("Exp", x), graph.constant([0], np.int64), output="variance")
    return graph.model("slip_regressor", metadata, (CHANNELS, "samples"), 2)
