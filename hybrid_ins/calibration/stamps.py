"""Times of a recording as stamps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FIRST = 1.0  # s, the stamp of a recording's first sample: no stamp is zero


def stamps_of(t: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the stamps [ns] of times [s] after a recording's first sample, any shape."""
    return np.asarray(np.round((t + FIRST) * 1e9), np.int64)
