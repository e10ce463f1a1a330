"""The figures of one run as text for a terminal, at most 80 columns wide."""

from __future__ import annotations

import textwrap

from hybrid_ins.evaluation.result import IMU_CLOCK, Result, degrees

_BANDS = (
    "1 for a correct covariance. NEES of one run is correlated: it is judged by the second band, of"
    " the equivalent number of independent values. NIS of a consistent filter is not: it is judged"
    " by the first. 'consistent' means within the band; errors of the covariance smaller than the"
    " band, and errors common to all fixes, cannot be seen."
)


def table(result: Result) -> str:
    """Return the figures as lines of at most 80 columns."""
    return "\n".join(
        (
            *map(_wrapped, _scored_lines(result)),
            *_accuracy_lines(result),
            *_consistency_lines(result),
            *map(_wrapped, _fix_lines(result)),
            *(_wrapped(f"note: {note}") for note in result.notes),
        )
    )


def summary(result: Result) -> dict[str, float | int | None]:
    """Return the figures of `table` by column title, for a table of several runs."""
    consistency = {
        "NEES/dof pos": result.nees_position,
        "NEES/dof vel": result.nees_velocity,
        "NEES/dof att": result.nees_attitude,
        "NIS/dof": result.nis_position,
    }
    return {
        "PRMSE [m]": result.prmse,
        "PMAE [m]": result.pmae,
        "largest [m]": result.largest_error,
        "velocity [m/s]": result.velocity_rmse,
        "heading [deg]": degrees(result.heading_rmse),
        "tilt [deg]": degrees(result.tilt_rmse),
        **{name: None if c is None else c.per_dof for name, c in consistency.items()},
        "coverage": result.coverage,
        "outages": len(result.outages),
        "at end [m]": result.outage_error(50),
        "within [m]": result.largest_outage_error,
    }


def _scored_lines(result: Result) -> list[str]:
    if result.epochs is None or result.coverage is None:
        return ["no truth: only the filter's own figures"]
    e, offset = result.epochs, result.time_offset
    left_out = [
        f"{count} {why}"
        for count, why in (
            (e.fed, "at fix stamps"),
            (e.skipped, "skipped"),
            (e.uncovered, "without estimate"),
            (e.invalid, "not finite"),
        )
        if count
    ]
    lines = [
        f"scored {e.scored} of {e.truth} truth epochs"
        + (f"; left out: {', '.join(left_out)}" if left_out else ""),
        f"estimate covers {100 * result.coverage:.1f} % of the truth, largest gap "
        f"{result.largest_gap:.3g} s; skipped {result.scoring.skip:g} s (--skip)",
    ]
    if offset.low or offset.high:
        shifted = "fix" if result.scoring.truth_clock == IMU_CLOCK else "truth"
        spread = f" ({offset.low:+.4f} to {offset.high:+.4f})" if offset.high > offset.low else ""
        lines.append(
            f"{shifted} stamps shifted by {offset.mean:+.4f} s{spread}, as given by the "
            f"{offset.source}"
        )
    return lines


def _accuracy_lines(result: Result) -> list[str]:
    if result.prmse is None:
        return []
    rows = (
        ("PRMSE", result.prmse, "m", (("horizontal", result.horizontal_rmse, "m"),
                                    ("vertical", result.vertical_rmse, "m"))),
        ("PMAE", result.pmae, "m", (("largest", result.largest_error, "m"),)),
        ("velocity RMSE", result.velocity_rmse, "m/s",
         (("along the body's axes", result.body_velocity_rmse, "m/s"),)),
        ("attitude RMSE", degrees(result.attitude_rmse), "deg",
         (("heading", degrees(result.heading_rmse), "deg"),
          ("tilt", degrees(result.tilt_rmse), "deg"))),
    )  # fmt: skip
    lines = ["", "accuracy"]
    for name, value, unit, parts in rows:
        line = f"  {name:15}{_figure(value, unit):>12}"
        if any(v is not None for _, v, _ in parts):
            line += "".join(f"   {part} {_figure(v, u)}" for part, v, u in parts)
        lines.append(line)
    return lines


def _consistency_lines(result: Result) -> list[str]:
    rows = [
        ("position NEES", result.nees_position),
        ("velocity NEES", result.nees_velocity),
        ("attitude NEES", result.nees_attitude),
        ("position NIS", result.nis_position),
        ("velocity NIS", result.nis_velocity),
    ]
    if result.fixes is not None and result.fixes.accepted < result.fixes.total:
        rows.insert(4, ("  with rejected", result.nis_tested))
    rows = [row for row in rows if row[1] is not None]
    if not rows:
        needed = "verdicts on fixes" if result.errors is None else "covariances and verdicts"
        return ["", f"consistency: not known without {needed}"]
    lines = ["", "consistency         /dof     n  95 % band  eff. n  95 % band"]
    for name, c in rows:
        assert c is not None
        low, high = c.band
        wide_low, wide_high = c.effective_band
        lines.append(
            f"  {name:15}{c.per_dof:7.3g}{c.count:6d}  {low:4.2f}-{high:4.2f}"
            f"{c.effective_count:8.0f}  {wide_low:4.2f}-{wide_high:<5.2f} {c.verdict}"
        )
    return [*lines, _wrapped(f"({_BANDS})", indent="  ")]


def _fix_lines(result: Result) -> list[str]:
    lines = [""]
    if result.fixes is not None:
        rejected = ", ".join(f"{count} {reason}" for reason, count in result.fixes.refused.items())
        lines.append(
            f"fixes: {result.fixes.accepted} of {result.fixes.total} accepted"
            + (f"; rejected: {rejected}" if rejected else "")
        )
    if result.outages:
        durations = sorted(o.duration for o in result.outages)
        span = f"{durations[0]:.1f} s" + (
            f" to {durations[-1]:.1f} s" if durations[-1] - durations[0] > 0.05 else ""
        )
        line = f"outages: {len(result.outages)} of {span}"
        median, p90 = result.outage_error(50), result.outage_error(90)
        if median is not None:
            line += f"; error at their ends: median {median:.3g} m, p90 {p90:.3g} m; "
            line += f"largest within {result.largest_outage_error:.3g} m"
        lines.append(line)
    return lines if len(lines) > 1 else []


def _figure(value: float | None, unit: str) -> str:
    return "-" if value is None else f"{value:.3g} {unit}"


def _wrapped(text: str, indent: str = "") -> str:
    return textwrap.fill(text, 80, initial_indent=indent, subsequent_indent=indent + "  ")
