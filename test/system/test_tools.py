"""Wrong arguments of the programs in `tools`: one line that says why, before any work."""

import importlib

import pytest


@pytest.mark.parametrize(
    ("name", "words", "complaint"),
    [
        ("benchmark.run", "--json {missing}/x.json", "benchmark: error: {missing}/x.json: no such"),
        ("regressor.vehicle_levels", "--model none", "error: 'none' is no model"),
        ("regressor.vehicle_levels", "--seeds -3", "error: argument --seeds: '-3' is not a whole"),
        ("robustness.endurance", "--hours -1", "error: argument --hours: -1 is not above zero"),
        ("robustness.endurance", "--seeds 0", "error: argument --seeds: 0 is not above zero"),
        ("robustness.endurance", "--imu-rate 0", "argument --imu-rate: 0 is not above zero"),
        ("robustness.endurance", "--hours 0.01 --param none 1", "error: parameter none: unknown"),
        ("robustness.heading", "--data {missing} --simulated 0", "error: {missing}/Horizontal"),
        ("robustness.heading", "--simulated 0", "error: nothing to run"),
        ("robustness.heading", "--jobs 0", "error: argument --jobs: 0 is not above zero"),
        ("robustness.live_fuzz", "--count 0", "error: argument --count: 0 is not above zero"),
        ("robustness.long_outage", "--hours 0", "error: argument --hours: 0 is not above zero"),
        ("robustness.mutate_files", "--count -1", "error: argument --count: '-1' is not a whole"),
        ("robustness.outage", "--runs 0", "error: argument --runs: 0 is not above zero"),
        ("robustness.outage", "--modes none", "error: argument --modes: invalid choice: 'none'"),
        ("robustness.soak", "--hours -1", "error: argument --hours: -1 is not above zero"),
        ("status_picture", "--flight {missing} --out {missing}/x.png", "{missing}/x.png: no such"),
        ("tutorial", "{missing}", "error: {missing}: holds no Horizontal"),
        ("vehicles.air", "{missing}", "error: {missing}/plane_x8/gnss.csv not found"),
        ("vehicles.calibrated", "none", "error: none: is not part of any name"),
        (
            "vehicles.calibrated",
            "--data {missing}",
            "error: {missing}: holds none of the real sets",
        ),
        ("vehicles.campaign", "--runs 0", "error: argument --runs: 0 is not above zero"),
        ("vehicles.campaign", "--results {missing}/x.json", "error: {missing}/x.json: no such"),
        ("vehicles.claims", "none", "error: none: is not part of any name"),
        ("vehicles.claims", "--jobs 0", "error: argument --jobs: 0 is not above zero"),
        ("vehicles.constraint", "none", "error: none: is not part of any name"),
        ("vehicles.constraint", "--data {missing}", "error: {missing}: holds none of the real"),
        ("vehicles.evaluate", "none", "error: none: is not part of any name"),
        ("vehicles.evaluate", "--params-file {missing}", "error: {missing}: No such file"),
        ("vehicles.hindsight", "--data {missing} none", "error: {missing}: holds none of the real"),
        ("vehicles.log_outages", "{missing} --jobs 1", "error: {missing}: no such file"),
        ("vehicles.outages", "none", "argument NAME: invalid choice: 'none'"),
    ],
)
def test_wrong_arguments_are_one_line(
    name: str, words: str, complaint: str, capfd: pytest.CaptureFixture[str]
) -> None:
    main = importlib.import_module(f"tools.{name}").main
    missing = "/no/such/folder"
    try:
        status = main(words.format(missing=missing).split())
    except SystemExit as end:  # argparse
        status = end.code
    out, said = capfd.readouterr()
    assert status == 2
    assert complaint.format(missing=missing) in said
    assert said.count("\n") == 1
    assert not out  # no table begins


def test_the_drives_of_a_name_are_generated() -> None:
    from tools.vehicles import constraint, evaluate

    for drives in (evaluate.drives, constraint.drives):
        assert "pedestrian" in next(drives(["pedestrian"], [2], None)).name
