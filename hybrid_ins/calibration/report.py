"""A calibration as text: table, innovations before and after, parameter file."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.calibration.calibrate import Calibration
from hybrid_ins.calibration.filter_pass import FilterPass
from hybrid_ins.calibration.findings import Finding
from hybrid_ins.calibration.innovations import POSITION, VELOCITY
from hybrid_ins.core.update import chi_square
from hybrid_ins.parameters import PARAMETERS
from hybrid_ins.parameters.parameter_file import to_yaml

Array = NDArray[np.float64]


def table(findings: Sequence[Finding]) -> str:
    """Return the findings as a table with a line for each."""
    rows = [
        ("", "value", "σ", "verdict"),
        *(
            (f.label, f.value, f.sigma, f.verdict + (f": {f.note}" if f.note else ""))
            for f in findings
        ),
    ]
    widths = [max(len(row[k]) for row in rows) for k in range(3)]
    return "\n".join(
        "  ".join(
            [row[0].ljust(widths[0]), row[1].rjust(widths[1]), row[2].rjust(widths[2]), row[3]]
        ).rstrip()
        for row in rows
    )


def innovation_line(calibration: Calibration) -> str:
    """Return a line with the innovations before and after the calibration."""
    kinds = np.concatenate([one.aid_kind for one in calibration.fitted.recordings])
    z, nis = zip(*map(_innovations, (calibration.before, calibration.after)), strict=True)
    texts = []
    for kind, unit in ((POSITION, "m"), (VELOCITY, "m/s")):
        if np.any(kinds == kind):
            rms = [np.sqrt(np.nanmean(one[kinds == kind] ** 2)) for one in z]
            texts.append(f"RMS {rms[0]:.3f} -> {rms[1]:.3f} {unit}")
    before, after = map(np.nanmedian, nis)
    expected = _expected_median(np.isfinite(z[1]).sum(axis=1))
    return (
        f"innovations: {', '.join(texts)}, "
        f"median NIS {before:.1f} -> {after:.1f} ({expected:.1f} expected)"
    )


def _innovations(passes: Sequence[FilterPass]) -> tuple[Array, Array]:
    """Return innovations (M, 3), NaN where nothing was measured, and their squares (M,)."""
    return np.concatenate([p.z for p in passes]), np.concatenate([p.nis for p in passes])


def _expected_median(sizes: NDArray[np.int64]) -> float:
    """Return the median of the NIS of consistent innovations with so many components (M,)."""
    numbers, counts = np.unique(sizes[sizes > 0], return_counts=True)
    shares = counts / counts.sum()
    return chi_square.quantile_of_mixture(
        0.5, dict(zip(numbers.tolist(), shares.tolist(), strict=True))
    )


def parameter_file(calibration: Calibration) -> str:
    """Return a parameter file with what was found and what differs from the defaults."""
    chosen = {
        name: value
        for name, value in calibration.values.items()
        if name in calibration.notes or value != PARAMETERS[name].default
    }
    names = ", ".join(recording.name for recording in calibration.fitted.recordings)
    return to_yaml(chosen, f"Written by ins_calibrate from {names}", calibration.notes)
