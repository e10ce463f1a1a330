"""A trajectory in geodetic coordinates, cut into parts of one quality, for maps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.inertial.earth import LocalFrame
from hybrid_ins.ros.messages.conversions import SWAP
from hybrid_ins.ros.messages.trajectory import Array, Trajectory

INTERVAL_NS = 100_000_000  # between the points of a map: viewers are slow with more
LONGEST_GAP_NS = 2_000_000_000  # a line is not drawn over more


@dataclass(frozen=True, slots=True)
class Quality:
    """A class of horizontal standard deviations, and how it is drawn."""

    name: str
    below: float  # m
    colour: str  # RRGGBB
    garmin_colour: str  # the colours of a GPX file have names


QUALITIES = (
    Quality("σ below 0.05 m", 0.05, "009E73", "Green"),
    Quality("σ below 0.3 m", 0.3, "56B4E9", "Cyan"),
    Quality("σ below 2 m", 2.0, "E69F00", "Yellow"),
    Quality("σ below 10 m", 10.0, "D55E00", "Red"),
    Quality("σ of 10 m or more", np.inf, "CC79A7", "Magenta"),
    Quality("σ not known", np.nan, "8A8A8A", "DarkGray"),
)


@dataclass(frozen=True, eq=False)
class Part:
    """Consecutive points of one quality."""

    quality: Quality
    stamp_ns: NDArray[np.int64]  # (N,)
    lat_lon_height: Array  # (N, 3) deg, deg, m above the ellipsoid


def lat_lon_height(trajectory: Trajectory) -> Array:
    """Return geodetic positions (N, 3) [deg, deg, m]; NaN where the datum is unknown."""
    if trajectory.datum_lla is None:
        return np.full((len(trajectory), 3), np.nan)
    lla = LocalFrame(trajectory.datum_lla).lla(trajectory.position_enu @ SWAP)
    return np.column_stack((np.degrees(lla[:, :2]), lla[:, 2]))


def horizontal_std(trajectory: Trajectory) -> Array:
    """Return the largest horizontal standard deviation (N,) [m]; NaN where it is unknown."""
    if trajectory.position_cov is None:
        return np.full(len(trajectory), np.nan)
    P = trajectory.position_cov[:, :2, :2]
    usable = np.asarray(np.isfinite(P).all(axis=(1, 2)))
    largest = np.linalg.eigvalsh(np.where(usable[:, None, None], P, np.eye(2)))[:, 1]
    return np.sqrt(np.where(usable & (largest > 0.0), largest, np.nan))


def parts(trajectory: Trajectory) -> Iterator[Part]:
    """
    Cut a trajectory into parts of one quality, thinned to a point every `INTERVAL_NS`.

    A part begins with the last point of the one before it, so that the line is not interrupted,
    except where no estimate was published for longer than `LONGEST_GAP_NS`.
    """
    bins = trajectory.stamp_ns // INTERVAL_NS
    keep = np.flatnonzero(np.diff(bins, prepend=bins[0] - 1) > 0)
    if keep[-1] != len(trajectory) - 1:
        keep = np.append(keep, len(trajectory) - 1)
    thinned = trajectory.rows(keep)
    positions = lat_lon_height(thinned)
    sigma = horizontal_std(thinned)
    limits = [quality.below for quality in QUALITIES[:-1]]
    index = np.where(np.isnan(sigma), len(limits), np.searchsorted(limits, sigma, side="right"))
    gap = np.diff(thinned.stamp_ns) > LONGEST_GAP_NS
    edges = np.flatnonzero((np.diff(index) != 0) | gap) + 1
    for first, stop in zip([0, *edges], [*edges, len(thinned)], strict=True):
        begin = first if first == 0 or gap[first - 1] else first - 1
        yield Part(QUALITIES[index[first]], thinned.stamp_ns[begin:stop], positions[begin:stop])


def utc(stamp_ns: int) -> str:
    """Return a stamp as ISO 8601 text in UTC, with milliseconds."""
    milliseconds = (int(stamp_ns) + 500_000) // 1_000_000
    time = datetime(1970, 1, 1, tzinfo=timezone.utc) + timedelta(milliseconds=milliseconds)
    return time.isoformat(timespec="milliseconds").replace("+00:00", "Z")
