"""A calibration as text: table, innovations before and after, parameter file."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hybrid_ins.calibration.filter_pass import FilterPass
from hybrid_ins.calibration.findings import Calibration, Finding
from hybrid_ins.parameters import PARAMETERS
from hybrid_ins.parameters.parameter_file import to_yaml


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

    def figures(passes: Sequence[FilterPass]) -> tuple[float, float]:
        z = np.concatenate([p.z[np.isfinite(p.nis)] for p in passes])
        nis = np.concatenate([p.nis[np.isfinite(p.nis)] for p in passes])
        return float(np.sqrt(np.nanmean(z**2))), float(np.median(nis))

    before, after = figures(calibration.before), figures(calibration.after)
    return (
        f"innovations: RMS {before[0]:.3f} -> {after[0]:.3f} m, "
        f"median NIS {before[1]:.1f} -> {after[1]:.1f} (2.4 expected)"
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
