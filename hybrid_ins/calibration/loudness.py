"""
How noisy the samples of recordings are, instant by instant, as the noise regressor reads them.

The readings contain motion and vibration besides noise, and not all of a vibration does what noise
does. So the likelihood weighs them: noise grows with a power of the loudness that is estimated.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.calibration.recording import Recording
from hybrid_ins.calibration.stamps import stamps_of
from hybrid_ins.core.imu.samples import ImuRing, as_samples
from hybrid_ins.noise_regressor.reader import NoiseReader

Array = NDArray[np.float64]

ORDINARY = 0.99  # share of the time in which the regressor reads less than the background


class Levels(NamedTuple):
    """Per-sample variances that the regressor reads in a recording."""

    t: Array  # (K,) s, the middles of its windows
    q: Array  # (K, 6)


def read_levels(
    recording: Recording,
    values: Mapping[str, Any],
    log: Callable[[str, str], None] = lambda level, text: None,
) -> Levels:
    """
    Return the noise levels of a recording, at the regressor's refresh period.

    Parameters
    ----------
    recording : Recording
    values : mapping
        Checked parameters: the regressor and its refresh period.
    log : callable
        Given level and text of the regressor's messages.
    """
    reader = NoiseReader(values, np.eye(3), log)
    t_ns, readings = stamps_of(recording.t), recording.samples
    samples = as_samples(t_ns, readings[:, :3], readings[:, 3:])
    reader.preload(samples["t_ns"], samples["f"], samples["w"])
    ring = ImuRing()
    count = max(1, round(values["noise.refresh_period"] / recording.period))
    t, levels = [], []
    for start in range(0, len(samples), count):
        ring.extend(samples[start : start + count])
        q = reader.read(ring, 0).q
        if q is not None:
            end = min(start + count, len(samples))
            t.append(float(np.mean(recording.t[[end - reader.regressor.window, end - 1]])))
            levels.append(q)
    return Levels(np.array(t), np.reshape(levels, (-1, 6)))


def with_loudness(recordings: Sequence[Recording], levels: Sequence[Levels]) -> list[Recording]:
    """Return the recordings with the loudness of their samples, relative to the mean over all."""
    log = [np.log(one.q).reshape(-1, 2, 3).mean(axis=2) for one in levels]
    if not sum(map(len, log)):
        return list(recordings)
    mean = np.mean(np.concatenate(log), axis=0)
    return [
        replace(
            recording,
            loudness=np.stack([np.interp(recording.t, t, column) for column in (q - mean).T], -1),
        )
        if len(t)
        else recording
        for recording, (t, _), q in zip(recordings, levels, log, strict=True)
    ]


def ordinary_levels(levels: Sequence[Levels]) -> Array | None:
    """Return the noise levels (6,) that are rarely exceeded; None if none was read."""
    q = np.concatenate([one.q for one in levels])
    return np.quantile(q, ORDINARY, axis=0) if len(q) else None
