"""The paper's evaluation runs from end to end and says what it must."""

from pathlib import Path

import pytest

pytest.importorskip("matplotlib", reason="figures need matplotlib")
pytest.importorskip("onnxruntime", reason="models run in onnxruntime")

from tools.paper import evaluate, navigation, scenarios
from tools.paper.report import Bar, at_least, at_most


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    folder = tmp_path_factory.mktemp("docs")
    assert evaluate.main(["--quick", "--out", str(folder)]) == 0
    return folder, (folder / "paper_evaluation.md").read_text(encoding="utf-8")


def test_every_figure_is_written_and_shown(report: tuple[Path, str]) -> None:
    folder, text = report
    for name in evaluate.FIGURES:
        assert (folder / "figures" / f"{name}.png").stat().st_size > 10_000
        assert f"(figures/{name}.png)" in text


def test_every_method_has_its_row_in_every_scenario(report: tuple[Path, str]) -> None:
    _, text = report
    tables = text.split("### ")[1:]
    navigation = [part for part in tables if "NEES (15)" in part]
    assert navigation.pop().startswith("How often")

    assert len(navigation) >= 3
    for part in navigation:
        for method in scenarios.METHODS:
            assert f"\n| {method.name} | " in part
    printed = [part for part in navigation if "\n| AQ1 literal | " in part]
    assert len(printed) == 2


def test_quick_figures_are_marked_as_such(report: tuple[Path, str]) -> None:
    assert "Its figures mean nothing" in report[1]


def test_a_bar_is_met_within_its_limits_only() -> None:
    for value, verdict in (
        (1.0, "stretch"),
        (1.015, "yes"),
        (1.03, "**no**"),
        (float("nan"), "no"),
    ):
        assert verdict in Bar("ratio", value, *at_most(1.02, 1.01)).row().rsplit("|", 2)[1]
    assert "≥ 20" in Bar("gain", 21.0, *at_least(20.0, 25.0)).row()
    assert "13 – 18" in Bar("NEES", 15.0, (13.0, 18.0)).row()


def test_seeds_of_development_and_evaluation_do_not_meet() -> None:
    flown = {navigation.FLIGHT_SEED + k for k in range(200)} | {
        navigation.ASIDE_SEED + k for k in range(200)
    }

    assert not flown & set(range(navigation.DEVELOPMENT_SEED + 200))


@pytest.mark.parametrize("words", [["--runs", "1"], ["--runs", "-3"], ["--jobs", "many"]])
def test_wrong_arguments_are_refused(words: list[str]) -> None:
    with pytest.raises(SystemExit) as leave:
        evaluate.main(words)
    assert leave.value.code == 2
