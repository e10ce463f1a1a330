"""The field experiment runs from end to end on real flights and says what it must."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("matplotlib", reason="figures need matplotlib")
pytest.importorskip("onnxruntime", reason="models run in onnxruntime")

from tools.field import evaluate
from tools.field.groups import Group
from tools.field.methods import BEST, OURS, TUNED
from tools.field.tasks import Row


def rows() -> list[Row]:
    made = []
    for flight, session, best in (("H1", "a", "q 1"), ("H2", "b", "q 2")):
        for method in ("q 1", "q 2", OURS):
            prmse = 1.0 if method == best else 2.0
            made.append(
                {
                    "condition": "5 Hz",
                    "flight": flight,
                    "session": session,
                    "imu": 1,
                    "seed": 0,
                    "method": method,
                    "prmse": prmse,
                }
            )
    return made


def test_constant_is_tuned_on_the_other_session_and_the_bound_on_the_flight_itself() -> None:
    group, chosen = Group.of(rows(), "5 Hz").with_constants(["q 1", "q 2"])
    assert chosen == {"a": "q 2", "b": "q 1"}
    np.testing.assert_array_equal(group.values(TUNED, "prmse"), [2.0, 2.0])
    np.testing.assert_array_equal(group.values(BEST, "prmse"), [1.0, 1.0])
    assert set(group.rows) == {OURS, TUNED, BEST}


def test_a_folder_without_flights_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert evaluate.main(["--data", str(tmp_path), "--out", str(tmp_path)]) == 2
    assert "holds no Horizontal/path_2" in capsys.readouterr().err


def test_report_of_a_few_flights(
    flights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["--data", str(flights), "--quick", "--jobs", "1", "--out", str(tmp_path)]
    assert evaluate.main(words) == 0
    text = (tmp_path / "field_experiment.md").read_text(encoding="utf-8")
    assert "Its figures mean nothing" in text
    for name in ("field_fig8", "field_fig9", "field_fig10"):
        assert (tmp_path / f"figures/{name}.png").stat().st_size > 10_000
        assert f"(figures/{name}.png)" in text
    # AND what was finished is not done again
    for name in ("fly_task", "calibrate_task", "simulate_task"):

        def again(*_: object) -> None:
            pytest.fail("a finished part was done again")

        again.__name__ = name
        monkeypatch.setattr(evaluate, name, again)
    (tmp_path / "field_experiment.md").unlink()
    assert evaluate.main(words) == 0
    assert (tmp_path / "field_experiment.md").is_file()
