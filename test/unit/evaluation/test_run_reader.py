"""Reading a run from its bags."""

from pathlib import Path

import numpy as np
import pytest
from support.recordings import (
    DATUM,
    FAST,
    TRUTH,
    bag,
    flight,
    navsatfix,
    set_stamp,
    stamps,
    write_track,
    write_verdict,
)

from hybrid_ins.bags.messages import new_message
from hybrid_ins.errors import InputError
from hybrid_ins.evaluation.run import Topics
from hybrid_ins.evaluation.run_reader import read_run


def test_everything_that_was_recorded_is_read(tmp_path: Path) -> None:
    with bag(tmp_path / "run", flight(TRUTH)) as out:
        write_track(out, "/odometry", flight(FAST))
        for below in ("", "/truth"):
            for second, stamp_ns in enumerate(stamps([1.0, 2.0])):
                bias = new_message("geometry_msgs/msg/AccelWithCovarianceStamped")
                set_stamp(bias, stamp_ns)
                bias.accel.accel.linear.x, bias.accel.accel.angular.z = 0.5, -0.1
                bias.accel.covariance = np.diag([4.0, 4.0, 4.0, 9.0, 9.0, 9.0]).ravel()
                out.write(f"{below}/imu/bias", bias, int(stamp_ns))
                noise = new_message("geometry_msgs/msg/Vector3Stamped")
                set_stamp(noise, stamp_ns)
                noise.vector.y = 1.0 + second
                out.write(f"{below}/q/gyroscope", noise, int(stamp_ns))
        for stamp_ns, source in zip(
            stamps([0.0, 1.0, 2.0, 3.0]), ("none", "fallback", "learned", "learned"), strict=True
        ):
            array = new_message("diagnostic_msgs/msg/DiagnosticArray")
            set_stamp(array, stamp_ns)
            status, pair = map(
                new_message,
                ("diagnostic_msgs/msg/DiagnosticStatus", "diagnostic_msgs/msg/KeyValue"),
            )
            status.name, pair.key, pair.value = "hybrid_ins: process noise", "source", source
            status.values.append(pair)
            array.status.append(status)
            out.write("/diagnostics", array, int(stamp_ns))
        lost = navsatfix(int(stamps(1.1)), DATUM, status=-1)
        out.write("/gnss/fix", lost, int(stamps(1.1)))
        write_verdict(out, int(stamps(1.2)), kind="position", accepted="false", reason="late")
        write_verdict(out, int(stamps(1.4)), accepted="true", nis="1.5", dof="x")

    run = read_run(tmp_path / "run")

    for errors in (run.sensor_errors, run.true_sensor_errors):
        assert errors.accelerometer_bias is not None
        assert errors.gyroscope_bias is not None
        assert errors.accelerometer_bias.values[0].tolist() == [0.5, 0.0, 0.0]
        assert errors.gyroscope_bias.values[0].tolist() == [0.0, 0.0, -0.1]
        assert errors.gyroscope_bias.sigma is not None
        assert errors.gyroscope_bias.sigma[0].tolist() == [3.0, 3.0, 3.0]
        assert errors.accelerometer_noise is None
        assert errors.gyroscope_noise is not None
        assert errors.gyroscope_noise.values[:, 1].tolist() == [1.0, 2.0]
    assert [source for _, source in run.noise_source] == ["fallback", "learned"]
    assert len(run.fixes) == 101  # without the one that says it is none
    assert run.verdicts.reason.tolist() == ["late", ""]
    assert run.verdicts.accepted.tolist() == [False, True]
    assert np.isnan(run.verdicts.dof).all()
    assert run.truth is not None
    assert run.truth.datum_lla == pytest.approx(DATUM)


def test_what_diagnostics_warned_of_for_long_is_a_note(tmp_path: Path) -> None:
    with bag(tmp_path / "run", flight(TRUTH)) as out:
        write_track(out, "/odometry", flight(FAST))
        for second in range(15):
            stamp_ns = int(stamps(float(second)))
            array = new_message("diagnostic_msgs/msg/DiagnosticArray")
            set_stamp(array, np.int64(stamp_ns))
            for name, level, text in (
                (
                    "robot/hybrid_ins: process noise",
                    int(second > 3),
                    "source: x; the IMU disagrees",
                ),
                ("robot/hybrid_ins: clock", 1, f"it seems to be {0.1 * second:.2f} s"),
                ("robot/hybrid_ins: input", 2 if second < 5 else 0, "imu: frozen"),
                ("robot/hybrid_ins: filter", 1, "aligning"),
            ):
                status = new_message("diagnostic_msgs/msg/DiagnosticStatus")
                status.name, status.level, status.message = name, int(level), text
                array.status.append(status)
            out.write("/diagnostics", array, stamp_ns)

    notes = [note for note in read_run(tmp_path / "run").notes if "diagnostics" in note]

    assert notes == [
        "diagnostics, for 15 of 15 s: it seems to be 1.40 s",
        "diagnostics, for 11 of 15 s: the IMU disagrees",
    ]


def test_a_recording_is_no_estimate(tmp_path: Path) -> None:
    """It was said to have no Odometry, although it had the truth's."""
    with bag(tmp_path / "recording", flight(TRUTH)) as out:
        out.write("/imu/data", new_message("sensor_msgs/msg/Imu"), int(stamps(1.0)))

    with pytest.raises(InputError, match="a recording, not an estimate: run ins_replay"):
        read_run(tmp_path / "recording")


@pytest.mark.parametrize("topics", [Topics(fix="/nosuch"), Topics(verdict="nosuch")])
def test_a_topic_that_is_named_and_missing_is_an_error(tmp_path: Path, topics: Topics) -> None:
    with bag(tmp_path / "run", flight(TRUTH)) as out:
        write_track(out, "/odometry", flight(FAST))

    with pytest.raises(InputError, match="no topic /nosuch"):
        read_run(tmp_path / "run", topics=topics)
