"""Recordings that cannot be calibrated are refused with the reason."""

from pathlib import Path

import pytest

from hybrid_ins import parameters
from hybrid_ins.calibration.recording import read_recording
from hybrid_ins.cli import simulate
from hybrid_ins.errors import InputError
from tools.robustness.disturbances import Flight
from tools.robustness.lasting_faults import by_another_clock


@pytest.mark.parametrize(
    ("ahead", "words"),
    [(18.0, "18.0 s ahead of the IMU's .*GPS time"), (-1.5e9, "years behind the IMU's")],
)
def test_fixes_of_another_clock_are_named(tmp_path: Path, ahead: float, words: str) -> None:
    bag, disturbed = tmp_path / "flight.mcap", tmp_path / "disturbed.mcap"
    assert simulate.main([str(bag), "--duration", "12", "--imu-rate", "50"]) == 0
    flight = Flight.read(bag, 0.0, 1.0)
    by_another_clock(ahead)(flight)
    flight.write(disturbed)
    values = parameters.defaults()

    assert len(read_recording(bag, values).aid_t) > 50
    with pytest.raises(InputError, match=words):
        read_recording(disturbed, values)
