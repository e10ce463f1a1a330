"""
One HTML file about a run: the four usual questions answered in words, picture, figures.

Self-contained, so that it can be sent: the picture is in it, and it loads nothing.
"""

from __future__ import annotations

import base64
import html
import io
import math
from pathlib import Path

import numpy as np

from hybrid_ins.errors import InputError
from hybrid_ins.evaluation.result import Result
from hybrid_ins.evaluation.run_reader import Recording, Series
from hybrid_ins.evaluation.statistics import Consistency
from hybrid_ins.plotting import run

_SETTLED = 1.5  # a standard deviation within this factor of its last value has settled
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
<img alt="{title}: track, errors within 3 sigma, NIS, biases, noise" src="{picture}">
<pre>{table}</pre>
</html>
"""


def check(path: Path) -> None:
    """
    Find out before the work whether a report can be written to `path`.

    Raises
    ------
    InputError
        Not ``.html``, no such folder, or matplotlib is not installed.

    """
    if path.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{path}: a report's name ends in .html")
    run.check(path.with_suffix(".png"))


def page(recording: Recording, result: Result) -> str:
    """Return the report as HTML."""
    picture = io.BytesIO()
    run.write(run.overview(recording, result), picture, "png")
    data = base64.b64encode(picture.getvalue()).decode("ascii")
    return _PAGE.format(
        title=html.escape(recording.name),
        answers="\n".join(
            f"<dt>{html.escape(question)}</dt>\n<dd>{html.escape(answer)}</dd>"
            for question, answer in answers(recording, result)
        ),
        picture=f"data:image/png;base64,{data}",
        table=html.escape(result.table()),
    )


def answers(recording: Recording, result: Result) -> list[tuple[str, str]]:
    """Answer the questions that a run is looked at with: (question, answer) each."""
    return [
        ("How far is it off?", _accuracy(result)),
        ("Am I consistent?", _consistency(result)),
        ("Why were fixes refused?", _refusals(result)),
        ("When did the biases converge?", _biases(recording, result)),
        ("What is Q doing?", _noise(recording)),
    ]


def _accuracy(result: Result) -> str:
    if result.prmse is None:
        return "There is no truth to say."
    parts = [f"PRMSE {result.prmse:.3g} m, largest error {result.largest_error:.3g} m"]
    if result.heading_rmse is not None:
        parts.append(f"heading RMSE {math.degrees(result.heading_rmse):.2g}°")
    median = result.outage_error(50)
    if median is not None:
        parts.append(f"{median:.3g} m at the end of an outage (median of {len(result.outages)})")
    return "; ".join(parts) + "."


def _consistency(result: Result) -> str:
    def said(name: str, consistency: Consistency | None) -> str:
        if consistency is None:
            return ""
        low, high = consistency.effective_band
        return (
            f"{name} is {consistency.per_dof:.2f} per dimension, "
            f"{consistency.verdict} ({low:.2f} to {high:.2f} would be expected)."
        )

    texts = [
        said("NEES of the position", result.nees_position),
        said("NIS of the fixes", result.nis_position),
    ]
    if result.nis_position is not None and result.nis_position.verdict == "overconfident":
        texts.append("Look at clock offset, lever arm and what the receiver claims, in this order.")
    return " ".join(filter(None, texts)) or "Neither covariances nor verdicts were recorded."


def _refusals(result: Result) -> str:
    if result.fixes is None:
        return "No verdicts were recorded."
    fixes = result.fixes
    if not fixes.refused:
        return f"None was: all {fixes.total} were fused."
    reasons = ", ".join(f"{count} × {reason}" for reason, count in fixes.refused.items())
    return f"{fixes.total - fixes.accepted} of {fixes.total} were: {reasons}."


def _biases(recording: Recording, result: Result) -> str:
    texts = []
    for name, series, scale, unit in (
        ("accelerometer", recording.sensor_errors.accelerometer_bias, 1.0, "m/s²"),
        ("gyroscope", recording.sensor_errors.gyroscope_bias, math.degrees(1.0), "deg/s"),
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
    return " ".join(texts) or "They were not recorded."


def settling_times(series: Series, origin_ns: int) -> list[float]:
    """
    Time [s] from which on each axis' standard deviation stays near its last value, shape (3,).

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


def _noise(recording: Recording) -> str:
    texts = []
    for name, series, unit in (
        ("accelerometer", recording.sensor_errors.accelerometer_noise, "(m/s²)²"),
        ("gyroscope", recording.sensor_errors.gyroscope_noise, "(rad/s)²"),
    ):
        if series is None:
            continue
        low, middle, high = np.nanquantile(series.values, (0.05, 0.5, 0.95), axis=0)
        axes = ", ".join(
            f"{axis} {m:.2g} ({a:.2g} to {b:.2g})"
            for axis, a, m, b in zip("xyz", low, middle, high, strict=True)
        )
        texts.append(f"{name.capitalize()}: {axes} {unit}, median and 5–95 %.")
    sources = list(dict.fromkeys(source for _, source in recording.noise_source))
    if sources:
        texts.append(f"Source: {', then '.join(sources)}.")
    return " ".join(texts) or "It was not recorded."
