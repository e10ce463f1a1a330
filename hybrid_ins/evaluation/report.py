"""
A report on one run as a single HTML file: questions and answers, picture, table.

The picture is embedded, and the file loads nothing else.
"""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hybrid_ins.errors import InputError
from hybrid_ins.evaluation.result import Result
from hybrid_ins.evaluation.run import Run, Series
from hybrid_ins.evaluation.statistics import Consistency
from hybrid_ins.evaluation.table import table
from hybrid_ins.output_file import check_output

_SETTLED = 1.5  # a standard deviation has settled within this factor of its last value
_PAGE = """\
<!DOCTYPE html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<title>{title}</title>
<style>
body {{ font: 16px/1.5 sans-serif; max-width: 100rem; margin: 2rem auto; padding: 0 1rem;
       color: #222; background: #fff }}
dl {{ max-width: 60rem }}
dt {{ font-weight: bold; margin-top: .8rem }}
dd {{ margin: 0 }}
img {{ max-width: 100% }}
pre {{ overflow-x: auto }}
</style>
<h1>{title}</h1>
<dl>
{answers}
</dl>
<img alt="{title}: track, errors with 3 sigma, NIS, biases, noise" src="{picture}">
<pre>{table}</pre>
</html>
"""


def check(path: Path, inputs: Sequence[Path] = (), overwrite: bool = False) -> None:
    """
    Check, before the work, that a report can be written to `path`.

    Raises
    ------
    InputError
        Not ``.html``; for the rest see `output_file.check_output`.

    """
    if path.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{path}: a report's name ends in .html")
    check_output(path, inputs, overwrite)


def page(run: Run, result: Result, picture_png: bytes) -> str:
    """Return the report as HTML, with the run's picture embedded."""
    data = base64.b64encode(picture_png).decode("ascii")
    return _PAGE.format(
        title=html.escape(run.name),
        answers="\n".join(
            f"<dt>{html.escape(question)}</dt>\n<dd>{html.escape(answer)}</dd>"
            for question, answer in answers(run, result)
        ),
        picture=f"data:image/png;base64,{data}",
        table=html.escape(table(result)),
    )


def answers(run: Run, result: Result) -> list[tuple[str, str]]:
    """Return the questions of the report with their answers."""
    return [
        ("How accurate is the estimate?", _accuracy(result)),
        ("Are the covariances consistent?", _consistency(result)),
        ("Why were fixes rejected?", _rejections(result)),
        ("When did the biases converge?", _biases(run, result)),
        ("Which process noise was used?", _noise(run)),
    ]


def _accuracy(result: Result) -> str:
    if result.prmse is None:
        return "Not known: there is no truth."
    parts = [f"PRMSE {result.prmse:.3g} m, largest error {result.largest_error:.3g} m"]
    if result.heading_rmse is not None:
        parts.append(f"heading RMSE {math.degrees(result.heading_rmse):.2g}°")
    elif not result.heading_known:
        parts.append("the heading was never known")
    median = result.outage_error(50)
    if median is not None:
        parts.append(f"{median:.3g} m at the end of an outage (median of {len(result.outages)})")
    return "; ".join(parts) + "."


def _consistency(result: Result) -> str:
    def sentence(name: str, consistency: Consistency | None) -> str:
        if consistency is None:
            return ""
        low, high = consistency.band if consistency.independent else consistency.effective_band
        return (
            f"{name} is {consistency.per_dof:.2f} per degree of freedom: "
            f"{consistency.verdict} (95 % band {low:.2f} to {high:.2f})."
        )

    texts = [
        sentence("NEES of the position", result.nees_position),
        sentence("NIS of the fixes", result.nis_position),
    ]
    if result.nis_position is not None and result.nis_position.verdict == "overconfident":
        texts.append(
            "Check the clock offset, the lever arm and the receiver's covariances, in this order."
        )
    return (
        " ".join(filter(None, texts))
        or "Not known: neither covariances nor verdicts were recorded."
    )


def _rejections(result: Result) -> str:
    if result.fixes is None:
        return "Not known: no verdicts were recorded."
    fixes = result.fixes
    if not fixes.refused:
        return f"All {fixes.total} fixes were accepted."
    reasons = ", ".join(f"{count} × {reason}" for reason, count in fixes.refused.items())
    return f"{fixes.total - fixes.accepted} of {fixes.total} fixes were rejected: {reasons}."


def _biases(run: Run, result: Result) -> str:
    texts = []
    for name, series, scale, unit in (
        ("accelerometer", run.sensor_errors.accelerometer_bias, 1.0, "m/s²"),
        ("gyroscope", run.sensor_errors.gyroscope_bias, math.degrees(1.0), "deg/s"),
    ):
        if series is None or series.sigma is None or len(series.stamp_ns) < 2:
            continue
        axes = ", ".join(
            f"{axis} "
            + (f"after {seconds:.0f} s to" if last < 0.5 * first else "not yet,")
            + f" ±{scale * last:.2g}"
            for axis, seconds, first, last in zip(
                "xyz",
                settling_times(series, result.origin_ns),
                series.sigma[0],
                series.sigma[-1],
                strict=True,
            )
        )
        texts.append(f"{name.capitalize()}: {axes} {unit} (1σ).")
    return " ".join(texts) or "Not known: they were not recorded."


def settling_times(series: Series, origin_ns: int) -> list[float]:
    """
    Return from when on [s] the standard deviation of each axis stays near its last value.

    Parameters
    ----------
    series : Series
        With `sigma`.
    origin_ns : int
        Zero of the times [ns].

    """
    assert series.sigma is not None
    unsettled = series.sigma > _SETTLED * series.sigma[-1]
    times = []
    for axis in range(3):
        late = np.flatnonzero(unsettled[:, axis])
        row = min(late[-1] + 1, len(unsettled) - 1) if len(late) else 0
        times.append(float(series.stamp_ns[row] - origin_ns) * 1e-9)
    return times


def _noise(run: Run) -> str:
    texts = []
    for name, series, unit in (
        ("accelerometer", run.sensor_errors.accelerometer_noise, "(m/s²)²"),
        ("gyroscope", run.sensor_errors.gyroscope_noise, "(rad/s)²"),
    ):
        if series is None:
            continue
        low, middle, high = np.nanquantile(series.values, (0.05, 0.5, 0.95), axis=0)
        axes = ", ".join(
            f"{axis} {m:.2g} ({a:.2g} to {b:.2g})"
            for axis, a, m, b in zip("xyz", low, middle, high, strict=True)
        )
        texts.append(f"{name.capitalize()}: {axes} {unit}, median and 5–95 %.")
    sources = list(dict.fromkeys(source for _, source in run.noise_source))
    if sources:
        texts.append(f"Source: {', then '.join(sources)}.")
    return " ".join(texts) or "Not known: it was not recorded."
