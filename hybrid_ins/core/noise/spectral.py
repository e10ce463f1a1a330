"""
Noise level of a window from its spectrum, with nothing trained.

Slow motion lives in a window's low DCT modes, white noise is equally strong in all of them: drop
the slow ones and average the rest. `variance` does that over all modes left and is the reference
that a trained regressor has to beat: its error on white noise is 9 % above the Cramer-Rao bound.
`plateau` averages only modes that agree with the low end, because that end of the spectrum is what
integrates into velocity: it stays right when vibration rises towards high frequency, or when the
sensor's own low-pass leaves nothing there. Where fast motion fills the low end, a floor above it
takes its place.

Both take windows (C, N): one channel a row, oldest sample first, any unit; both return per-sample
variances (C,) [unit^2], unchanged by an offset and scaling with the square of the unit.

References
----------
Percival & Walden, *Spectral Analysis for Physical Applications*, 1993, chapters 4 and 6.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SLOW_SHARE = 0.1  # of the modes: below 0.05 cycles a sample
MIN_WINDOW = 50
_BLOCK = 20
_TREND_DEGREE = 3
# Of a chi-square variable with one degree of freedom.
_MEDIAN_SHARE = 0.4549
_OUTLIER = 14.0
_MEAN_SHARE_KEPT = 0.9973
# Blocks of white noise agree this well, but for one in a few hundred.
_SAME_RATIO, _LOWEST_RATIO, _HIGHEST_RATIO = 4.0, 0.3, 3.0
_FLOOR_BLOCKS = 3


@lru_cache(maxsize=8)
def _analysis(size: int, tapered: bool) -> Array:
    """Return rows (0.9 N, N): DCT modes above the slow ones, blind to a cubic trend, unit norm."""
    if size < MIN_WINDOW:
        raise ValueError(f"a window of {size} samples is too short; {MIN_WINDOW} are needed")
    sample = np.arange(size) + 0.5
    modes = np.cos(np.pi / size * np.arange(round(SLOW_SHARE * size), size)[:, None] * sample)
    if tapered:
        modes *= np.kaiser(size, 12.0)
    trend, _ = np.linalg.qr(np.vander(2.0 * sample / size - 1.0, _TREND_DEGREE + 1))
    modes -= (modes @ trend) @ trend.T
    rows: Array = modes / np.linalg.norm(modes, axis=1, keepdims=True)
    rows.setflags(write=False)
    return rows


def _energies(windows: Array, tapered: bool = False) -> Array:
    """Return unit-gain mode energies (C, 0.9 N)."""
    # The rows cancel an offset only to rounding, which a large bias would lift above small noise.
    centred = windows - windows[:, :1]
    return np.square(centred @ _analysis(windows.shape[1], tapered).T)


def _robust_mean(energies: Array) -> Array:
    """Return the mean over the last axis without modes far above it, such as tones."""
    level = np.median(energies, axis=-1) / _MEDIAN_SHARE
    for _ in range(2):
        kept = energies <= _OUTLIER * level[..., None]
        total = np.maximum(kept.sum(axis=-1), 1)
        level = (kept * energies).sum(axis=-1) / total / _MEAN_SHARE_KEPT
    return np.asarray(level)


def variance(windows: Array) -> Array:
    """
    Return the per-sample variance (C,) of the white noise in windows (C, N).

    Raises
    ------
    ValueError
        If a window has fewer than 50 samples.
    """
    return _robust_mean(_energies(np.asarray(windows, dtype=float)))


def _end_of_motion(blocks: Array) -> NDArray[np.int64]:
    """
    Return the first block (C,) of blocks (C, B) that fast motion does not reach; 0 mostly.

    The spectrum of motion falls steeply from the first block on, to a floor. That of a sensor's
    low-pass is flat first, and no floor follows.
    """
    count = blocks.shape[1]
    steep = blocks[:, :-1] > _SAME_RATIO * blocks[:, 1:]
    first = np.where(steep, np.arange(1, count), 0).max(axis=1)
    at = np.arange(count) - first[:, None]
    floor = np.where((at >= 0) & (at < _FLOOR_BLOCKS), blocks, np.nan)
    low, high = np.nanmin(floor, axis=1), np.nanmax(floor, axis=1)
    above = np.where(at < 0, blocks, np.inf).min(axis=1)
    is_floor = (first <= count - _FLOOR_BLOCKS) & (high < _SAME_RATIO * low)
    return np.where(steep[:, 0] & is_floor & (above > high), first, 0)


def _low_end(energies: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return the mean (C,) of the blocks that agree with the low end, and whether all do (C,)."""
    channels, modes = energies.shape
    count = modes // _BLOCK
    blocks = _robust_mean(energies[:, : count * _BLOCK].reshape(channels, count, _BLOCK))
    # Two blocks that agree are a better reference than one; if not, one holds motion or vibration.
    first = np.arange(channels), _end_of_motion(blocks)
    low, high = np.sort((blocks[first], blocks[first[0], first[1] + 1]), axis=0)
    level = np.where(high < _SAME_RATIO * low, 0.5 * (low + high), low)
    for _ in range(3):
        ratio = blocks / np.maximum(level, np.finfo(float).tiny)[:, None]
        agree = (ratio >= _LOWEST_RATIO) & (ratio <= _HIGHEST_RATIO)
        total = agree.sum(axis=1)
        mean = np.where(agree, blocks, 0.0).sum(axis=1) / np.maximum(total, 1)
        level = np.where(total > 0, mean, level)
    return level, agree.all(axis=1)


def plateau(windows: Array) -> Array:
    """
    Return the low-frequency plateau of the noise in windows (C, N) as a per-sample variance (C,).

    The spectrum under a taper, which leaks little but knows less, replaces the plain one where it
    is not flat and clearly higher: there, a strong tone or step has leaked over it.

    Raises
    ------
    ValueError
        If a window has fewer than 50 samples.
    """
    windows = np.asarray(windows, dtype=float)
    plain, flat = _low_end(_energies(windows))
    tapered, _ = _low_end(_energies(windows, tapered=True))
    return np.asarray(np.where(~flat & (tapered < 0.5 * plain), tapered, plain))
