"""
The two noise regressors as torch modules, and the same graphs written as ONNX.

PaperNet rebuilds Or & Klein (2022, section III-C). PlateauNet is ours. Each `onnx_*` function
writes the trained weights into a graph by hand: the file holds nothing but the operators listed
here, the same bytes on every machine.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from scipy.fft import dct
from scipy.signal.windows import dpss, kaiser
from torch import Tensor, nn

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

OPSET = 17
IR_VERSION = 8


class PaperNet(nn.Module):
    """
    The paper's regressor: one channel's raw window in, its noise variance out.

    What the paper leaves open and how it is read here:

    - input is per channel (its text: "a series of 200 x 1 samples"), in SI units, not normalised;
    - "kernel size 20 with five filters", then "three filters" of sizes 10 and 5, stride 1, no
      padding;
    - leaky ReLU, then layer normalisation, after each convolution (the text's order);
    - layer normalisation spans (channel, length), with one gain and offset for each channel: over
      length alone, pooling would return a constant. This is also what MATLAB, which the authors
      used, does for an image input;
    - "four linear layers with 100, 80, 50 and 20 weights" have that many outputs and are followed
      by the one-output layer that "outputs the process noise variance".

    Parameters
    ----------
    window : int
        Samples in a window.
    """

    KERNELS = (20, 10, 5)
    FILTERS = (5, 3, 3)
    WIDTHS = (100, 80, 50, 20, 1)
    SLOPE = 0.01
    EPSILON = 1e-5

    def __init__(self, window: int = 200) -> None:
        super().__init__()
        self.window = window
        inputs = (1, *self.FILTERS[:-1])
        self.convolutions = nn.ModuleList(
            nn.Conv1d(i, o, k) for i, o, k in zip(inputs, self.FILTERS, self.KERNELS, strict=True)
        )
        self.gains = nn.ParameterList(torch.ones(o, 1) for o in self.FILTERS)
        self.offsets = nn.ParameterList(torch.zeros(o, 1) for o in self.FILTERS)
        widths = (self.FILTERS[-1], *self.WIDTHS)
        self.layers = nn.ModuleList(nn.Linear(i, o) for i, o in pairwise(widths))

    def forward(self, readings: Tensor) -> Tensor:
        """Return variances (B,) of windows (B, N)."""
        x = readings[:, None, :]
        for convolution, gain, offset in zip(
            self.convolutions, self.gains, self.offsets, strict=True
        ):
            x = nn.functional.leaky_relu(convolution(x), self.SLOPE)
            mean = x.mean(dim=(1, 2), keepdim=True)
            variance = (x - mean).square().mean(dim=(1, 2), keepdim=True)
            x = (x - mean) / torch.sqrt(variance + self.EPSILON) * gain + offset
        x = x.mean(dim=2)
        for layer in self.layers[:-1]:
            x = nn.functional.leaky_relu(layer(x), self.SLOPE)
        return self.layers[-1](x)[:, 0]


# --- Ours ----------------------------------------------------------------------------------------

Analysis = tuple[Array32, Array32]


def _unit_gain(rows: Array) -> Array:
    """Scale rows so that unit white noise comes out with unit variance."""
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def _bands(low: int, high: int) -> list[tuple[int, int]]:
    """Return mode ranges that widen with frequency: [low, ...) up to high."""
    edges = [low]
    while edges[-1] < high:
        edges.append(min(high, edges[-1] + max(2, round(0.18 * edges[-1]))))
    if len(edges) > 2 and edges[-1] - edges[-2] < 3:
        del edges[-2]
    return list(pairwise(edges))


def plateau_analysis(window: int) -> Analysis:
    """
    Return the fixed linear analysis in front of the network.

    Returns
    -------
    projections : (R, N) array
        Every row orthogonal to a constant and of unit norm. Rows are DCT modes of the window

        - with its cubic trend removed: sharpest and most efficient;
        - with the slowest Slepian sequences removed: blind to strong smooth motion;
        - under two Kaiser tapers: little leakage from strong tones and steps;
        - of its last half and last quarter alone: what the noise is *now*;

        and differences of order 1, 3 and 6 over short segments: where in time the noise is.
    averages : (J, R) array
        Mean over the rows of each band or segment: energies ``averages @ (projections @ x)**2``
        are each an unbiased variance of white noise.
    """
    projections: list[Array] = []
    groups: list[int] = []

    def add(rows: Array, low: int, high: int) -> None:
        for first, last in _bands(low, high):
            projections.append(rows[first:last])
            groups.append(last - first)

    def modes(count: int, taper: Array) -> Array:
        """DCT modes (count, window) of the window's last `count` samples under a taper."""
        rows = np.zeros((count, window))
        rows[:, window - count :] = dct(np.eye(count), type=2, norm="ortho", axis=0) * taper
        return rows

    def without(basis: Array, rows: Array) -> Array:
        """Remove the span of basis (K, n) in the last n samples of rows."""
        span, _ = np.linalg.qr(basis.T)
        rows = rows.copy()
        tail = rows[:, window - span.shape[0] :]
        tail -= (tail @ span) @ span.T
        return rows

    def polynomial(count: int, degree: int) -> Array:
        return np.polynomial.legendre.legvander(np.linspace(-1, 1, count), degree).T

    full = modes(window, np.ones(window))
    add(_unit_gain(without(polynomial(window, 3), full)), 5, window)
    for half_bandwidth in (4, 7):
        # Sequences beyond these hold less than 1e-9 of a motion slower than 0.02, 0.035
        # cycles/sample in a window of 200.
        sequences = dpss(window, half_bandwidth, 2 * half_bandwidth + 9)
        slow = np.vstack((np.ones(window), sequences))
        add(_unit_gain(without(slow, full)), len(slow), window)
    for beta, low in ((6.0, 6), (14.0, 10)):
        taper = np.asarray(kaiser(window, beta))
        # The constant goes after the taper has been applied: rows must sum to zero themselves.
        rows = modes(window, taper)
        add(_unit_gain(rows - rows.mean(axis=1, keepdims=True)), low, window)
    for share in (2, 4):
        count = window // share
        rows = modes(count, np.asarray(kaiser(count, 4.0)))
        add(_unit_gain(without(polynomial(count, 1), rows)), 4, count)
    segment = window // 10
    for order in (1, 3, 6):
        stencil = np.diff(np.eye(order + 1), n=order, axis=0)[0]
        for start in range(0, window, segment):
            rows = np.zeros((segment - order, window))
            for index in range(segment - order):
                rows[index, start + index : start + index + order + 1] = stencil
            projections.append(_unit_gain(rows))
            groups.append(segment - order)
    stacked = np.vstack(projections)
    averages = np.zeros((len(groups), len(stacked)))
    row = 0
    for index, count in enumerate(groups):
        averages[index, row : row + count] = 1.0 / count
        row += count
    return stacked.astype(np.float32), averages.astype(np.float32)


class PlateauNet(nn.Module):
    """
    Our regressor: the low-frequency plateau of a channel's noise, as a per-sample variance.

    The window is centred and divided by its largest magnitude; the energies of `plateau_analysis`
    are unbiased for white noise one by one. A small network looks at their *ratios* only and
    answers with a weight for each energy and one factor: the estimate is the weighted mean of
    energies times that factor. So scaling the input by s scales the output by s^2 and an offset
    changes nothing, whatever the weights are.

    Parameters
    ----------
    window : int
        Samples in a window.
    hidden : int
        Width of the network's two hidden layers.
    """

    FLOOR = 1e-18
    COARSE_LIMIT = 12.0
    FINE_LIMIT = 3.0
    SLOPE = 0.1

    def __init__(self, window: int = 200, hidden: int = 128) -> None:
        super().__init__()
        self.window = window
        projections, averages = plateau_analysis(window)
        self.projections: Tensor
        self.averages: Tensor
        self.register_buffer("projections", torch.from_numpy(projections), persistent=False)
        self.register_buffer("averages", torch.from_numpy(averages), persistent=False)
        energies = averages.shape[0]
        self.coarse = nn.Linear(energies + 1, hidden)
        self.coarse_gate = nn.Linear(hidden, energies)
        self.fine1 = nn.Linear(2 * energies + 1 + hidden, hidden)
        self.fine2 = nn.Linear(hidden, hidden)
        self.gate = nn.Linear(hidden, energies)
        self.factor = nn.Linear(hidden, 1)
        self.log_scale = nn.Linear(hidden, 1)
        with torch.no_grad():
            # Start from weights by the number of modes averaged: near the best for white noise.
            modes = torch.log(1.0 / self.averages.max(dim=1).values)
            for layer in (self.coarse_gate, self.gate, self.factor, self.log_scale):
                layer.weight *= 0.1
                layer.bias.zero_()
            self.coarse_gate.bias.copy_(modes)
            self.gate.bias.copy_(modes)
            self.log_scale.bias.fill_(-1.0)

    def energies(self, readings: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """
        Return what the learned part sees, for windows (B, N).

        Returns
        -------
        energies (B, J) log of the normalised window's energies; repeats (B, 1) share of samples
        that equal the one before; scale (B,) what the window was divided by.
        """
        repeats = (readings[:, 1:] == readings[:, :-1]).float().mean(dim=1, keepdim=True)
        x = readings - readings.mean(dim=1, keepdim=True)
        scale = x.abs().amax(dim=1, keepdim=True).clamp_min(1e-30)
        x = x / scale
        energies = torch.log((x @ self.projections.T).square() @ self.averages.T + self.FLOOR)
        return energies, repeats, scale[:, 0]

    def log_level(self, energies: Tensor, repeats: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """
        Return the log variance (B,) of the normalised windows.

        Returns
        -------
        level : the answer; coarse : the first stage's answer; log_scale : log of the scale of
        the error that the network expects, which training weighs windows with. All (B,).
        """
        x = energies - energies.mean(dim=1, keepdim=True)
        x = torch.cat((0.5 * x.clamp(-self.COARSE_LIMIT, self.COARSE_LIMIT), repeats), dim=1)
        first = nn.functional.leaky_relu(self.coarse(x), self.SLOPE)
        weights = torch.log_softmax(self.coarse_gate(first), dim=1)
        coarse = torch.logsumexp(weights + energies, dim=1, keepdim=True)
        # Seen from a first guess, a band is either in agreement (near zero) or far off.
        x = energies - coarse
        limit = self.FINE_LIMIT
        x = torch.cat((x.clamp(-limit, limit), (2.0 * x).tanh(), repeats, first), dim=1)
        x = nn.functional.leaky_relu(self.fine1(x), self.SLOPE)
        x = nn.functional.leaky_relu(self.fine2(x), self.SLOPE)
        weights = torch.log_softmax(self.gate(x), dim=1)
        level = torch.logsumexp(weights + energies, dim=1) + self.factor(x)[:, 0]
        return level, coarse[:, 0], self.log_scale(x)[:, 0]

    def forward(self, readings: Tensor) -> Tensor:
        """Return variances (B,) of windows (B, N)."""
        energies, repeats, scale = self.energies(readings)
        return torch.exp(self.log_level(energies, repeats)[0]) * scale.square()


# --- ONNX ----------------------------------------------------------------------------------------


class Graph:
    """A growing list of ONNX nodes."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def constant(self, value: object, dtype: type = np.float32) -> str:
        """Return the name of a constant."""
        name = f"c{len(self.constants)}"
        array = np.ascontiguousarray(np.asarray(value, dtype=dtype))
        self.constants.append(numpy_helper.from_array(array, name))
        return name

    def tensor(self, value: Tensor) -> str:
        """Return the name of a constant from torch."""
        return self.constant(value.detach().cpu().numpy())

    def add(self, operator: str, *inputs: str, output: str = "", **attributes: object) -> str:
        """Append a node; return the name of its output."""
        output = output or f"t{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, list(inputs), [output], **attributes))
        return output

    def linear(self, x: str, layer: nn.Linear) -> str:
        """Return the name of what a linear layer makes of rows."""
        return self.add("Gemm", x, self.tensor(layer.weight), self.tensor(layer.bias), transB=1)

    def model(
        self,
        name: str,
        metadata: Mapping[str, str],
        window: Sequence[int | str],
        variance: int | str = "channels",
    ) -> onnx.ModelProto:
        """Return the model, given the shapes of its input and its output."""
        graph = helper.make_graph(
            self.nodes,
            name,
            [helper.make_tensor_value_info("window", TensorProto.FLOAT, list(window))],
            [helper.make_tensor_value_info("variance", TensorProto.FLOAT, [variance])],
            self.constants,
        )
        model = helper.make_model(
            graph,
            producer_name="hybrid_ins",
            ir_version=IR_VERSION,
            opset_imports=[helper.make_opsetid("", OPSET)],
        )
        helper.set_model_props(model, dict(metadata))
        onnx.checker.check_model(model, full_check=True)
        return model


def onnx_paper(network: PaperNet, metadata: Mapping[str, str]) -> onnx.ModelProto:
    """Return the trained paper's network as an ONNX model."""
    graph = Graph()
    x = graph.add("Unsqueeze", "window", graph.constant([1], np.int64))
    for convolution, gain, offset in zip(
        network.convolutions, network.gains, network.offsets, strict=True
    ):
        assert isinstance(convolution, nn.Conv1d)
        assert convolution.bias is not None
        x = graph.add("Conv", x, graph.tensor(convolution.weight), graph.tensor(convolution.bias))
        x = graph.add("LeakyRelu", x, alpha=network.SLOPE)
        mean = graph.add("ReduceMean", x, axes=[1, 2], keepdims=1)
        x = graph.add("Sub", x, mean)
        square = graph.add("Mul", x, x)
        variance = graph.add("ReduceMean", square, axes=[1, 2], keepdims=1)
        variance = graph.add("Add", variance, graph.constant(network.EPSILON))
        x = graph.add("Div", x, graph.add("Sqrt", variance))
        x = graph.add("Add", graph.add("Mul", x, graph.tensor(gain)), graph.tensor(offset))
    x = graph.add("ReduceMean", x, axes=[2], keepdims=0)
    for layer in network.layers[:-1]:
        assert isinstance(layer, nn.Linear)
        x = graph.add("LeakyRelu", graph.linear(x, layer), alpha=network.SLOPE)
    last = network.layers[-1]
    assert isinstance(last, nn.Linear)
    x = graph.linear(x, last)
    graph.add("Squeeze", x, graph.constant([1], np.int64), output="variance")
    return graph.model("paper_noise_regressor", metadata, ("channels", network.window))


def onnx_plateau(network: PlateauNet, metadata: Mapping[str, str]) -> onnx.ModelProto:
    """Return our trained network as an ONNX model: normalisation and analysis included."""
    graph = Graph()
    window = network.window
    one = graph.constant([1], np.int64)
    half = graph.constant(0.5)
    later = graph.add(
        "Slice", "window", one, graph.constant([window], np.int64), graph.constant([1], np.int64)
    )
    first, last = graph.constant([0], np.int64), graph.constant([window - 1], np.int64)
    earlier = graph.add("Slice", "window", first, last, one)
    same = graph.add("Cast", graph.add("Equal", later, earlier), to=TensorProto.FLOAT)
    repeats = graph.add("ReduceMean", same, axes=[1], keepdims=1)
    x = graph.add("Sub", "window", graph.add("ReduceMean", "window", axes=[1], keepdims=1))
    scale = graph.add("ReduceMax", graph.add("Abs", x), axes=[1], keepdims=1)
    scale = graph.add("Max", scale, graph.constant(1e-30))
    x = graph.add("Div", x, scale)
    x = graph.add("MatMul", x, graph.constant(network.projections.numpy().T))
    x = graph.add("MatMul", graph.add("Mul", x, x), graph.constant(network.averages.numpy().T))
    energies = graph.add("Log", graph.add("Add", x, graph.constant(network.FLOOR)))
    mean = graph.add("ReduceMean", energies, axes=[1], keepdims=1)

    def clip(x: str, limit: float) -> str:
        return graph.add("Clip", x, graph.constant(-limit), graph.constant(limit))

    def activated(x: str, layer: nn.Linear) -> str:
        return graph.add("LeakyRelu", graph.linear(x, layer), alpha=network.SLOPE)

    def gated(x: str, gate: nn.Linear) -> str:
        weights = graph.add("LogSoftmax", graph.linear(x, gate), axis=1)
        total = graph.add("Add", weights, energies)
        return graph.add("ReduceLogSumExp", total, axes=[1], keepdims=1)

    x = graph.add("Mul", clip(graph.add("Sub", energies, mean), network.COARSE_LIMIT), half)
    first = activated(graph.add("Concat", x, repeats, axis=1), network.coarse)
    x = graph.add("Sub", energies, gated(first, network.coarse_gate))
    near = graph.add("Tanh", graph.add("Mul", x, graph.constant(2.0)))
    x = graph.add("Concat", clip(x, network.FINE_LIMIT), near, repeats, first, axis=1)
    x = activated(activated(x, network.fine1), network.fine2)
    level = gated(x, network.gate)
    level = graph.add("Exp", graph.add("Add", level, graph.linear(x, network.factor)))
    level = graph.add("Mul", level, graph.add("Mul", scale, scale))
    graph.add("Squeeze", level, one, output="variance")
    return graph.model("plateau_noise_regressor", metadata, ("channels", window))
