"""ins_evaluate: what it reads, prints, writes and refuses."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.recordings import (
    DATUM,
    FAST,
    START_NS,
    TRUTH,
    bag,
    flight,
    navsatfix,
    run_program,
    shifted,
    stamps,
    with_sigma,
    write_track,
    write_verdict,
)
from support.streams import closed_pipe

from hybrid_ins.cli.evaluate import main
from hybrid_ins.core.inertial.earth import LocalFrame


@pytest.fixture
def truth_bag(tmp_path: Path) -> Path:
    with bag(tmp_path / "truth.mcap", flight(TRUTH)):
        pass
    return tmp_path / "truth.mcap"


@pytest.fixture
def estimate_bag(tmp_path: Path) -> Path:
    there = LocalFrame(DATUM).lla(np.array([30.0, -20.0, 3.0]))
    estimate = shifted(with_sigma(flight(FAST), 0.5), [-0.3, -0.4, 0.0])
    with bag(tmp_path / "estimate") as out:
        write_track(out, "/odometry", estimate.in_map_of(there))
        out.write("/datum", navsatfix(START_NS, there), START_NS)
        for stamp_ns in stamps(TRUTH[::2]):
            write_verdict(
                out, stamp_ns, kind="position", accepted="true", nis="2.5", dof="3",
                threshold="16.3", time_offset="0.0",
            )  # fmt: skip
    return tmp_path / "estimate"


def test_two_bags_with_different_datums(
    estimate_bag: Path, truth_bag: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, _ = run_program(capsys, 0, estimate_bag, "--truth", truth_bag, "--json")

    figures = json.loads(out)
    assert figures["prmse_m"] == pytest.approx(0.5, abs=1e-6)
    assert figures["pmae_m"] == pytest.approx(0.7, abs=1e-5)
    assert figures["velocity_rmse_mps"] == pytest.approx(0.0, abs=1e-6)
    assert figures["nees_position"]["mean"] == pytest.approx(1.0, abs=1e-5)
    assert figures["nees_attitude"]["mean"] == pytest.approx(0.0, abs=1e-9)
    assert figures["nis_position"]["per_dof"] == pytest.approx(2.5 / 3)
    assert figures["epochs"]["fed"] == 101
    assert figures["notes"] == []


def test_truth_of_another_place_is_doubted(
    tmp_path: Path, truth_bag: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    elsewhere = np.array([DATUM[0] + 0.01, *DATUM[1:]])
    with bag(tmp_path / "estimate") as out:
        write_track(out, "/odometry", replace(flight(FAST), datum_lla=elsewhere))
        out.write("/datum", navsatfix(START_NS, elsewhere), START_NS)

    text, _ = run_program(capsys, 0, tmp_path / "estimate", "--truth", truth_bag)

    assert "the truth is 64 km off, in another place: is it of this run?" in text


def test_table_and_truth_beside_the_estimate(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with bag(tmp_path / "both", flight(TRUTH)) as out:
        write_track(out, "/odometry", flight(FAST))

    text, _ = run_program(capsys, 0, tmp_path / "both")

    assert "scored 100 of 201 truth epochs; left out: 101 at fix stamps" in text
    assert "the estimate's datum is not in the bag" in " ".join(text.split())


def test_no_truth_is_an_error_unless_asked_for(
    estimate_bag: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, error = run_program(capsys, 2, estimate_bag)
    text, _ = run_program(capsys, 0, estimate_bag, "--no-truth")

    assert "--truth" in error
    assert error.count("\n") == 1
    assert "position NIS" in text


def test_no_odometry_names_what_there_is(
    truth_bag: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, error = run_program(capsys, 2, truth_bag)

    assert "no topic /odometry" in error
    assert "/truth/odometry" in error.partition("it has")[2]


def test_a_zero_quaternion_is_no_attitude(
    tmp_path: Path, truth_bag: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with bag(tmp_path / "estimate") as out:
        write_track(out, "/odometry", replace(flight(FAST), quat_xyzw=None))

    out_text, _ = run_program(capsys, 0, tmp_path / "estimate", "--truth", truth_bag, "--json")

    figures = json.loads(out_text)
    assert figures["prmse_m"] == pytest.approx(0.0, abs=1e-6)
    assert figures["attitude_rmse_deg"] is None
    assert figures["velocity_rmse_mps"] is None
    assert any("quaternions are invalid" in note for note in figures["notes"])


def test_nan_zero_stamps_and_repeated_stamps_are_left_out_and_said(
    tmp_path: Path, truth_bag: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    estimate = flight(FAST)
    position, stamp_ns = estimate.position_enu.copy(), estimate.stamp_ns.copy()
    position[500] = np.nan
    stamp_ns[600] = 0
    stamp_ns[700] = stamp_ns[699]
    position[699] = 1e6  # before the correction at the same stamp
    with bag(tmp_path / "estimate") as out:
        write_track(
            out,
            "/odometry",
            replace(estimate, position_enu=position, stamp_ns=stamp_ns, velocity_enu=None),
        )

    text, _ = run_program(capsys, 0, tmp_path / "estimate", "--truth", truth_bag, "--json")

    notes = " ".join(json.loads(text)["notes"])
    assert "1 of 2001 messages ignored: no time stamp" in notes
    assert "1 of 2000 messages ignored: NaN" in notes
    assert "1 messages repeat" in notes
    assert "every velocity is zero" in notes
    assert json.loads(text)["prmse_m"] < 0.1


def test_other_topics_and_frames(
    tmp_path: Path, truth_bag: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with bag(tmp_path / "estimate") as out:
        write_track(out, "/odometry/filtered", flight(FAST), ("odom", "base_footprint"))

    text, _ = run_program(
        capsys, 0, tmp_path / "estimate", "--truth", truth_bag, "--odometry",
        "odometry/filtered", "--json",
    )  # fmt: skip

    assert any("'odom'" in note for note in json.loads(text)["notes"])


def test_the_clock_of_another_programs_estimate_is_asked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # GIVEN fixes stamped 0.1 s behind the IMU's clock, which both estimates share
    with bag(tmp_path / "both") as out:
        write_track(out, "/odometry", flight(FAST))
        write_track(out, "/odometry/filtered", flight(TRUTH))
        for stamp_ns in stamps(TRUTH[::2] - 0.1):
            write_verdict(out, stamp_ns, accepted="true", nis="3.0", dof="3", time_offset="0.1")
    other = tmp_path / "both", "--truth-topic", "odometry/filtered", "--json"

    taken, _ = run_program(capsys, 0, *other)
    said, _ = run_program(capsys, 0, *other, "--truth-clock", "imu")

    assert json.loads(taken)["prmse_m"] == pytest.approx(1.0)
    assert any("--truth-clock imu" in note for note in json.loads(taken)["notes"])
    assert json.loads(said)["prmse_m"] == pytest.approx(0.0, abs=1e-9)
    assert not any("--truth-clock" in note for note in json.loads(said)["notes"])


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["EST", "--skip", "-1"],
        ["EST", "--skip", "soon"],
        ["EST", "--time-offset", "nan"],
        ["EST", "--unknown"],
    ],
)
def test_wrong_arguments(arguments: list[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(arguments)

    assert stopped.value.code == 2


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["/nowhere/bag"], "/nowhere/bag"),
        (["EST", "--truth", "/nowhere/truth"], "/nowhere/truth"),
        (["EST", "--truth", "EST", "--no-truth"], "exclude"),
        (["EST", "--truth", "EST"], "/truth/odometry"),
        (["EST", "--plot", "picture.bmp"], ".png or .svg"),
        (["EST", "--plot", "/nowhere/picture.png"], "no such folder"),
        (["EST", "--odometry", "/gnss/verdict"], "diagnostic_msgs"),
    ],
)
def test_what_cannot_be_used_is_one_clear_line(
    estimate_bag: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    text: str,
) -> None:
    given = [str(estimate_bag) if a == "EST" else a for a in arguments]

    _, error = run_program(capsys, 2, *given)

    assert text in error
    assert error.startswith("ins_evaluate: error: ")
    assert error.count("\n") == 1


def test_an_estimate_without_any_usable_message(
    tmp_path: Path, truth_bag: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    estimate = flight(FAST[:5])
    with bag(tmp_path / "estimate") as out:
        write_track(out, "/odometry", replace(estimate, position_enu=np.full((5, 3), np.nan)))

    _, error = run_program(capsys, 2, tmp_path / "estimate", "--truth", truth_bag)

    assert "no usable message" in error


@pytest.mark.slow
def test_a_closed_pipe_does_not_lose_picture_report_and_track(
    estimate_bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("matplotlib")
    files = [tmp_path / name for name in ("run.svg", "run.html", "run.csv")]
    options = zip(("--plot", "--report", "--export"), map(str, files), strict=True)

    with closed_pipe(monkeypatch):
        assert main([str(estimate_bag), "--no-truth", *(p for o in options for p in o)]) == 0

    assert all(file.stat().st_size > 1000 for file in files)


def test_a_name_that_is_no_utf_8_is_drawn_and_written(
    estimate_bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    odd = estimate_bag.rename(tmp_path / os.fsdecode(b"caf\xe9"))

    files = [tmp_path / name for name in ("run.png", "run.html", "two.png")]
    run_program(capsys, 0, odd, "--no-truth", "--plot", files[0], "--report", files[1])
    run_program(capsys, 0, odd, odd, "--no-truth", "--plot", files[2], "--jobs", "1")

    assert all(file.stat().st_size > 1000 for file in files)
    assert "caf?" in files[1].read_text(encoding="utf-8")


def test_files_are_replaced_only_on_request_and_never_the_input(
    estimate_bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    for option, name in (("--plot", "x.svg"), ("--report", "x.html"), ("--export", "x.csv")):
        file = tmp_path / name
        file.write_text("mine")
        given = [estimate_bag, "--no-truth", option, file]

        _, error = run_program(capsys, 2, *given)
        assert f"{file}: exists: give --overwrite" in error
        assert file.read_text() == "mine"
        run_program(capsys, 0, *given, "--overwrite")
        assert file.stat().st_size > 1000

    [recording] = estimate_bag.glob("*.mcap")
    inside = recording.rename(recording.with_suffix(".csv"))  # a bag by its content
    _, error = run_program(capsys, 2, inside, "--no-truth", "--export", inside, "--overwrite")
    assert "is the input itself" in error
