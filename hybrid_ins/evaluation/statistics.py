"""
Consistency and comparison: chi-square bands, NEES, paired ratios with their uncertainty.

References
----------
.. [1] Y. Bar-Shalom, X. R. Li, T. Kirubarajan, *Estimation with Applications to Tracking and
       Navigation*, 2001, section 5.4 (NEES and NIS, their bands).
.. [2] C. Geyer, *Practical Markov chain Monte Carlo*, Statistical Science 7, 1992 (how many
       independent values a correlated series is worth).
.. [3] A. C. Davison, D. V. Hinkley, *Bootstrap Methods and their Application*, 1997, section 3.8
       (resampling whole clusters).
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

PROBABILITY = 0.95


def nees(error: ArrayLike, covariance: ArrayLike) -> Array:
    """
    Normalised estimation error squared, error' P^-1 error; [1]_ eq. 5.4.2-3.

    Parameters
    ----------
    error : array_like, shape (..., n)
        True minus estimated.
    covariance : array_like, shape (..., n, n)
        Its covariance as stated by the filter.

    Returns
    -------
    ndarray, shape (...)
        NaN where the error is not finite or the covariance not positive definite.

    """
    e, P = np.broadcast_arrays(np.asarray(error, float)[..., None], np.asarray(covariance, float))
    e = e[..., :1]
    # Scaled to unit diagonal: metres and radians in one matrix are not singular.
    sigma = np.sqrt(np.maximum(np.diagonal(P, axis1=-2, axis2=-1), 0.0))
    scale = np.where(sigma > 0.0, sigma, np.nan)[..., None]
    with np.errstate(invalid="ignore"):
        correlation = P / scale / np.swapaxes(scale, -1, -2)
    usable = np.isfinite(correlation).all(axis=(-2, -1)) & np.isfinite(e).all(axis=(-2, -1))
    safe = np.where(usable[..., None, None], correlation, np.eye(P.shape[-1]))
    usable &= np.linalg.eigvalsh(safe)[..., 0] > 1e-12
    safe = np.where(usable[..., None, None], safe, np.eye(P.shape[-1]))
    e = np.where(usable[..., None, None], e / scale, np.nan)
    values: Array = np.sum(e * np.linalg.solve(safe, e), axis=(-2, -1))
    return values


def mean_band(dof: float, count: float, probability: float = PROBABILITY) -> tuple[float, float]:
    """Two-sided band of the mean of `count` independent chi-square(`dof`) values; [1]_ 5.4.2."""
    if not count > 0.0:
        return 0.0, float("inf")
    from scipy.special import gammaincinv  # here: it takes longer to load than numpy

    tail = 0.5 * (1.0 - probability)
    low, high = 2.0 * gammaincinv(0.5 * dof * count, [tail, 1.0 - tail]) / count
    return float(low), float(high)


def effective_count(values: ArrayLike) -> float:
    """
    Return the equivalent number of independent values of a correlated series; [2]_ 3.3.

    The autocorrelations are summed in pairs as long as the pairs are positive.
    """
    x = np.asarray(values, float)
    x = x[np.isfinite(x)]
    n = len(x)
    if n < 4 or np.ptp(x) == 0.0:
        return float(n)
    x = x - np.mean(x)
    power = float(x @ x)
    spectrum = np.fft.rfft(x, 2 * n)
    correlation = np.fft.irfft(spectrum * spectrum.conj())[:n] / power
    pairs = correlation[: n - n % 2].reshape(-1, 2).sum(axis=1)
    negative = np.flatnonzero(pairs <= 0.0)
    pairs = pairs[: negative[0]] if len(negative) else pairs
    return float(np.clip(n / max(2.0 * np.sum(pairs) - 1.0, 1.0), 1.0, n))


@dataclass(frozen=True)
class Consistency:
    """
    The mean of a chi-square statistic (NEES, NIS) and its band for a correct covariance.

    The band tests one thing: whether chance explains the distance of the mean from its degrees of
    freedom. A mean within it does not prove the covariance; errors of the covariance that are
    smaller than the band remain undetected.
    """

    dof: float  # degrees of freedom of one value (their mean, where they differ)
    count: int
    effective_count: float  # equivalent number of independent values
    mean: float
    independent: bool = False  # values of a consistent filter are independent: NIS, not NEES

    @classmethod
    def of(
        cls, values: ArrayLike, dof: ArrayLike, *, independent: bool = False
    ) -> Consistency | None:
        """Summarise `values` (N,) with `dof`, scalar or (N,); None where none is finite."""
        x, d = np.broadcast_arrays(np.asarray(values, float), np.asarray(dof, float))
        x, d = x[np.isfinite(x)], d[np.isfinite(x)]
        if not len(x):
            return None
        equivalent = effective_count(x / d)
        return cls(float(np.mean(d)), len(x), equivalent, float(np.mean(x)), independent)

    @property
    def per_dof(self) -> float:
        """The mean over its degrees of freedom: 1 for a correct covariance."""
        return self.mean / self.dof

    @property
    def band(self) -> tuple[float, float]:
        """95 % band of `per_dof` if all values were independent."""
        return self._band(self.count)

    @property
    def effective_band(self) -> tuple[float, float]:
        """95 % band of `per_dof` for the equivalent number of independent values."""
        return self._band(self.effective_count)

    @property
    def verdict(self) -> Literal["consistent", "overconfident", "conservative"]:
        """
        Whether the mean lies within its band, above or below it.

        The innovations of a consistent filter are white ([1]_ section 5.4.2), so NIS is tested
        with the band of `count` independent values: correlated innovations must not widen it.
        """
        low, high = self.band if self.independent else self.effective_band
        if self.per_dof > high:
            return "overconfident"
        return "conservative" if self.per_dof < low else "consistent"

    def as_dict(self) -> dict[str, object]:
        """For JSON: every field and property under its own name."""
        names = ("mean", "dof", "per_dof", "count", "band", "effective_count", "effective_band")
        return {name: getattr(self, name) for name in (*names, "verdict")}

    def _band(self, count: float) -> tuple[float, float]:
        low, high = mean_band(self.dof, count)
        return low / self.dof, high / self.dof


@dataclass(frozen=True)
class RunAverage:
    """NEES averaged over Monte Carlo runs, epoch by epoch; [1]_ eq. 5.4.2-4."""

    dof: int
    runs: int
    per_epoch: Array  # (K,) mean over the runs

    @classmethod
    def of(cls, errors: ArrayLike, covariances: ArrayLike) -> RunAverage:
        """Average over axis 0 of `errors` (runs, K, n) with `covariances` (runs, K, n, n)."""
        e = np.asarray(errors, float)
        return cls(e.shape[-1], e.shape[0], np.mean(nees(e, covariances), axis=0))

    @property
    def mean(self) -> float:
        """Mean over runs and epochs: `dof` for a consistent filter."""
        return float(np.mean(self.per_epoch))

    @property
    def band(self) -> tuple[float, float]:
        """Two-sided 95 % band of one epoch's average over independent runs."""
        return mean_band(self.dof, self.runs)


@dataclass(frozen=True)
class Ratio:
    """A comparison of paired runs with its bootstrap interval."""

    ratio: float
    low: float
    high: float
    pairs: int
    clusters: int

    def __str__(self) -> str:
        return f"{self.ratio:.3f} [{self.low:.3f}, {self.high:.3f}]"


def paired_ratio(
    figures: ArrayLike,
    against: ArrayLike,
    clusters: Sequence[Hashable],
    *,
    of: Literal["pairs", "means"] = "pairs",
    probability: float = PROBABILITY,
    resamples: int = 10_000,
    seed: int = 0,
) -> Ratio:
    """
    Compare paired figures, with whole clusters (flights) resampled for the interval; [3]_.

    Runs of one flight with other IMUs or seeds share its difficulties: they are no independent
    evidence, the flights are.

    Parameters
    ----------
    figures, against : array_like, shape (N,)
        Positive figures of the same runs with the method and with what it is compared to.
    clusters : sequence of N hashables
        Which flight each pair belongs to.
    of
        ``"pairs"``: geometric mean of the ratios, every run weighs the same. ``"means"``: ratio
        of the mean figures, hard flights weigh more.
    probability, resamples, seed
        Coverage of the interval, bootstrap samples, and their seed.

    Raises
    ------
    ValueError
        Lengths differ, nothing to compare, or a figure is not positive and finite.

    """
    a, b = np.asarray(figures, float), np.asarray(against, float)
    if a.shape != b.shape or a.ndim != 1 or len(clusters) != len(a) or not len(a):
        raise ValueError("paired figures and clusters must be equally many, and at least one")
    if not (np.all(a > 0.0) and np.all(b > 0.0) and np.all(np.isfinite(a) & np.isfinite(b))):
        raise ValueError("figures must be positive and finite")
    names = list(dict.fromkeys(clusters))
    member = np.array([names.index(c) for c in clusters])
    first, second = (np.log(a / b), np.ones(len(a))) if of == "pairs" else (a, b)
    top, bottom = (np.bincount(member, x, len(names)) for x in (first, second))

    def combine(total_top: Array, total_bottom: Array) -> Array:
        quotient = total_top / total_bottom
        return np.exp(quotient) if of == "pairs" else quotient

    drawn = np.random.default_rng(seed).integers(len(names), size=(resamples, len(names)))
    samples = combine(top[drawn].sum(axis=1), bottom[drawn].sum(axis=1))
    tail = 0.5 * (1.0 - probability)
    low, high = np.quantile(samples, (tail, 1.0 - tail))
    ratio = float(combine(np.asarray(top.sum()), np.asarray(bottom.sum())))
    return Ratio(ratio, float(low), float(high), len(a), len(names))
