"""The report of the field experiment."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tools.field.groups import Group, method_table
from tools.field.methods import HARDER, NO_SCALE, ONLINE, OURS, PAPER_TABLE, TUNED
from tools.field.tasks import BLOCK, INJECTED, MISFITS, Row
from tools.paper.report import Bar, at_most, interval, table


@dataclass(frozen=True)
class Findings:
    """
    What the experiment found.

    Attributes
    ----------
    command : str
        How many flights, by which command, and how long it took.
    quick : bool
        The figures mean nothing.
    calibrations, simulated : list of Row
        One for each flight and IMU; one for each simulated run and method.
    groups : dict of str to Group
        The flown runs by condition.
    chosen : sequence of dict
        Constant tuned for each session, at 5 Hz, at 1 Hz and with injected noise.
    shown : list of (float, float)
        Quietest noise in the spectra of accelerometer and gyroscope, and its median.
    needed : (float, float)
        The calibrated noise of both.
    """

    command: str
    quick: bool
    calibrations: list[Row]
    simulated: list[Row]
    groups: dict[str, Group]
    chosen: Sequence[Mapping[str, str]]
    shown: list[tuple[float, float]]
    needed: tuple[float, float]


def bars_of(found: Findings) -> list[Bar]:
    """Return what is to be reached, and what was."""
    groups, simulated = found.groups, found.simulated
    five, one, noisy, outage = (groups[n] for n in ("5 Hz", "1 Hz", "injected", "outage"))
    away = np.array(
        [1e3 * abs(r["offset"] - r["exact"]) for r in found.calibrations if r["span"] >= 20.0]
    )
    online = offset_errors(found)
    lever = {
        (r["session"], r["imu"]): 100.0
        * float(np.hypot(*np.subtract(r["imu_position"], r["exact_position"])[:2]))
        for r in found.calibrations
    }
    ends = outage.values(OURS, "end")

    def mean(group: Group, figure: str, name: str = OURS) -> float:
        return float(np.mean(group.values(name, figure)))

    bars = [
        Bar(
            "clock offset, worst flight [ms]",
            float(away.max()),
            *at_most(20.0, 10.0),
            f" (median {np.median(away):.0f})",
        ),
        *(
            Bar(
                f"clock offset online after 20 s, {what} calibrated, worst of {len(off)} runs [ms]",
                float(off.max()),
                *at_most(30.0, 15.0),
                f" (median {np.median(off):.0f}, {np.sum(off <= 30.0)} within 30)",
            )
            for what, off in (
                ("nothing", online["online 5 Hz"]),
                ("the rest", online["online 5 Hz, the rest calibrated"]),
            )
        ),
        Bar(
            "lever arm, horizontally, worst IMU and session [cm]",
            max(lever.values()),
            *at_most(5.0, 2.0),
            f" (median {np.median(list(lever.values())):.1f})",
        ),
        Bar("PRMSE, 5 Hz [m]", mean(five, "prmse"), *at_most(0.145, 0.130)),
        Bar("PRMSE, 1 Hz [m]", mean(one, "prmse"), *at_most(0.26, 0.240)),
        Bar(
            "10 s outage end, median [m]",
            float(np.nanmedian(ends)),
            *at_most(2.3, 1.8),
            f" (p90 {np.nanpercentile(ends, 90):.1f})",
        ),
    ]
    for label, group, limits in (
        ("5 Hz", five, at_most(1.02, 1.0)),
        ("1 Hz", one, at_most(1.02, 1.0)),
        ("strong injected noise", noisy, at_most(0.95, 0.92)),
    ):
        ratio = group.ratio(OURS, TUNED)
        value = np.inf if ratio is None else ratio.ratio
        bars.append(
            Bar(
                f"PRMSE against the constant tuned on the other session, {label}",
                value,
                *limits,
                interval(ratio),
            )
        )
    for label, group in (("5 Hz", five), ("1 Hz", one)):
        bars += [
            Bar(f"NIS/3, {label}", mean(group, "nis"), (0.85, 1.25), (0.9, 1.1)),
            Bar(f"NEES/3, {label}", mean(group, "nees"), (0.7, 1.7), (0.8, 1.3)),
        ]
    published = groups["published 5 Hz"]
    bars += [
        Bar(
            "clock as published: PRMSE, 5 Hz [m]",
            mean(published, "prmse"),
            *at_most(0.40, 0.30),
            f" (worst {published.values(OURS, 'prmse').max():.2f})",
        ),
        Bar("clock as published: NIS/3, 5 Hz", mean(published, "nis"), (0.5, 2.0)),
    ]
    for kind in MISFITS:
        by = _simulated(simulated, kind)
        best = min((v for n, v in by.items() if n not in (OURS, NO_SCALE)), key=lambda v: v[0])
        if kind == "right model":
            bars.append(
                Bar(
                    "cost of the innovation scale, consistent simulations [%]",
                    100.0 * (by[OURS][0] / by[NO_SCALE][0] - 1.0),
                    *at_most(1.0, 0.3),
                )
            )
            continue
        bars += [
            Bar(
                f"simulated {kind}: PRMSE / hindsight constant",
                by[OURS][0] / best[0],
                *at_most(1.10, 1.05),
            ),
            Bar(f"simulated {kind}: NEES/3", by[OURS][1], *at_most(2.0, 1.5)),
        ]
    for label, group in (("5 Hz", five), ("1 Hz", one)):
        cost = mean(group, "prmse") / mean(group, "prmse", NO_SCALE) - 1.0
        bars.append(
            Bar(
                f"cost of the innovation scale, calibrated flights, {label} [%]",
                100.0 * cost,
                *at_most(1.0, 0.3),
            )
        )
    return bars


def offset_errors(found: Findings) -> dict[str, np.ndarray]:
    """Return by how much the offset found while flying is off after 20 s [ms], for each run."""
    exact = {(r["flight"], r["imu"]): r["exact"] for r in found.calibrations}
    return {
        condition: np.array(
            [
                1e3 * abs(r["offset_20"] - exact[r["flight"], r["imu"]])
                for r in found.groups[condition].rows[OURS]
            ]
        )
        for condition in ONLINE
    }


def report(found: Findings) -> str:
    """Return the document."""
    groups, simulated = found.groups, found.simulated
    bars = bars_of(found)
    five, one, noisy, outage = (groups[n] for n in ("5 Hz", "1 Hz", "injected", "outage"))
    ends = [
        (
            name,
            f"{np.nanmedian(outage.values(name, 'end')):.2f}",
            f"{np.nanpercentile(outage.values(name, 'end'), 90):.2f}",
        )
        for name in outage.rows
    ]
    others = []
    for label in HARDER:
        for name in groups[label].rows:
            group = groups[label]
            others.append(
                (
                    label,
                    name,
                    *(
                        f"{group.values(name, f).mean():.3f}"
                        for f in ("prmse", "pmae", "nees", "nis")
                    ),
                    f"{group.values(name, 'prmse').max():.2f}",
                )
            )
    calibration = [
        (
            r["flight"],
            r["imu"],
            f"{r['offset']:+.3f} ± {r['sigma']:.3f}",
            f"{r['exact']:+.3f} ± {r['exact_sigma']:.3f}",
            f"{1e3 * (r['offset'] - r['exact']):+.0f}",
            _centimetres(r["imu_position"]),
            _centimetres(r["exact_position"]),
        )
        for r in found.calibrations
    ]
    misfits = []
    for kind in MISFITS:
        by = _simulated(simulated, kind)
        best = min((n for n in by if n not in (OURS, NO_SCALE)), key=lambda n: by[n][0])
        misfits.append(
            (
                kind,
                f"{by[OURS][0]:.3f}",
                f"{by[OURS][1]:.2f}",
                f"{by[NO_SCALE][0]:.3f}",
                f"{by[NO_SCALE][1]:.1f}",
                f"{by[best][0]:.3f} (× {best})",
                f"{by[best][1]:.2f}",
            )
        )
    quick = (
        ["**Quick mode: a few flights, to see that the program works. Its figures mean nothing.**"]
        if found.quick
        else []
    )
    text = Path(__file__).with_name("text.md").read_text(encoding="utf-8")
    head, _, tail = text.partition("<!-- figures -->")
    return "\n\n".join(
        (
            "# The field experiment",
            *quick,
            found.command,
            "## Targets and results",
            table(("figure", "measured", "bar", "stretch", "met"), ())
            + "\n"
            + "\n".join(bar.row() for bar in bars),
            head.strip(),
            "## The paper's Table 2, on these flights",
            method_table([("5 Hz", five)]),
            method_table([("1 Hz", one)]),
            "Constants tuned on the other session: "
            + "; ".join(
                f"{label} {', '.join(sorted(set(c.values())))}"
                for label, c in zip(("5 Hz", "1 Hz", "injected noise"), found.chosen, strict=True)
            )
            + ".",
            "The paper's own flight, PRMSE / PMAE [m]: "
            + ", ".join(f"{name} {p[1]} / {p[0]}" for name, p in PAPER_TABLE.items())
            + ".",
            "![A flight](figures/field_fig8.png)",
            "*The paper's Fig. 8: one flight, reference, fixes and estimate.*",
            "![Levels](figures/field_fig9.png)",
            "*The paper's Fig. 9: levels in force on that flight.*",
            "![Distribution](figures/field_fig10.png)",
            "*The paper's Fig. 10: distribution of PRMSE over all runs at 5 Hz.*",
            "## IMU spectra and the noise that navigation needs",
            "![Spectra](figures/field_spectra.png)",
            "*Spectra of IMU 1 on all flights, as the variance per sample of white noise of "
            "that density, against the noise that `ins_calibrate` found.*",
            table(
                ("", "calibrated noise", "quietest frequency, 5 % of windows", "its median"),
                [
                    (sensor, f"{needed:.2g}", f"{low:.2g}", f"{middle:.2g}")
                    for sensor, needed, (low, middle) in zip(
                        ("accelerometer [(m/s²)²]", "gyroscope [(rad/s)²]"),
                        found.needed,
                        found.shown,
                        strict=True,
                    )
                ],
            ),
            "## Outages of 10 s: error at their end",
            table(("method", "median [m]", "p90 [m]"), ends),
            f"## Strong noise injected every other {BLOCK:g} s",
            f"White, {INJECTED[0]:g} m/s² and {INJECTED[1]:g} rad/s per sample.",
            method_table([("5 Hz", noisy)]),
            "## Worse starts, nothing calibrated, clock found while flying",
            table(
                (
                    "condition",
                    "method",
                    "PRMSE [m]",
                    "PMAE [m]",
                    "NEES/3",
                    "NIS/3",
                    "worst run [m]",
                ),
                others,
            ),
            "Clock offset in force 20 s after the first sample, against the one by the reference:",
            table(
                ("condition", "median [ms]", "p90 [ms]", "worst [ms]", "within 30 ms"),
                [
                    (
                        condition,
                        f"{np.median(off):.0f}",
                        f"{np.percentile(off, 90):.0f}",
                        f"{off.max():.0f}",
                        f"{np.sum(off <= 30.0)} of {len(off)}",
                    )
                    for condition, off in offset_errors(found).items()
                ],
            ),
            "## Errors that the IMU's noise does not show, simulated",
            table(
                (
                    "error",
                    "ours: PRMSE [m]",
                    "NEES/3",
                    "without scale: PRMSE [m]",
                    "NEES/3",
                    "best constant: PRMSE [m]",
                    "NEES/3",
                ),
                misfits,
            ),
            "## Calibration, flight by flight",
            "Clock offset [s] from fixes of 5 Hz and from the reference itself, their "
            "difference [ms], IMU in base_link (forward, left, up) [cm] by both.",
            table(
                (
                    "flight",
                    "IMU",
                    "offset",
                    "by the reference",
                    "difference",
                    "IMU position",
                    "by the reference",
                ),
                calibration,
            ),
            tail.strip(),
        )
    )


def _centimetres(position: Sequence[float]) -> str:
    return ", ".join(f"{100.0 * p:+.0f}" for p in position)


def _simulated(rows: Iterable[Row], kind: str) -> dict[str, tuple[float, float]]:
    """Mean PRMSE [m] and NEES/3 by method."""
    by: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        if row["kind"] == kind:
            by.setdefault(row["method"], []).append((row["prmse"], row["nees"]))
    return {name: tuple(np.mean(v, axis=0).tolist()) for name, v in by.items()}
