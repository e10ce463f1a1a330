"""Logs as strangers bring them: other times, units, separators, axes; cut and damaged files."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from dataclasses import replace
from functools import cache, reduce
from operator import xor
from pathlib import Path

import numpy as np
import pytest
from support.scenes import scene

from hybrid_ins.bags.reader import BagReader
from hybrid_ins.cli import convert
from hybrid_ins.dataset.convert_logs import convert_logs
from hybrid_ins.dataset.logs import ardupilot, formats, gnss_text, imu_text, nmea, rtklib, ubx
from hybrid_ins.dataset.logs.plausibility import (
    check_clocks,
    check_imu,
    check_positions,
    check_velocity,
    mount_yaw,
    turn_factor,
)
from hybrid_ins.dataset.logs.series import (
    FIX,
    GBAS_FIX,
    GPS_EPOCH,
    SBAS_FIX,
    GnssLog,
    ImuLog,
    diagonal,
    rising,
)
from hybrid_ins.errors import InputError
from hybrid_ins.ros.messages.conversions import FLIP
from hybrid_ins.simulation import motions

NOON = 1_700_049_600.0  # 2023-11-15T12:00:00Z
PLACE, THERE = "lat,lon,height", "32.1,34.8,50.0"


def table(path: Path, header: str, *rows: str) -> GnssLog:
    path.write_text(header + "\n" + "\n".join(rows) + "\n")
    assert formats.format_of(path) is gnss_text
    return gnss_text.read_gnss(path)


@pytest.mark.parametrize(
    ("header", "first", "second"),
    [
        ("time", "2023-11-15T14:00:00+02:00", "2023-11-15T14:00:01+02:00"),
        ("time", "2023-11-15 06:30:00-0530", "2023-11-15 06:30:01-0530"),
        ("date,time", "11/15/2023,12:00:00", "11/15/2023,12:00:01"),
        ("date,time", "15/11/2023,12:00:00", "15/11/2023,12:00:01"),
        ("date,time", "151123,120000.0", "151123,120001.0"),
    ],
)
def test_dates_and_zones(tmp_path: Path, header: str, first: str, second: str) -> None:
    rows = [f"{words},{THERE}" for words in (first, second)]
    assert table(tmp_path / "f", f"{header},{PLACE}", *rows).t.tolist() == [NOON, NOON + 1.0]


def test_units_in_the_names_of_columns(tmp_path: Path) -> None:
    names = "time,lat,lon,height [mm],hAcc_mm,vAcc [mm],speed_kmh,course,sAcc (mm/s)"
    row = "32.1,34.8,50000,20,30,36.0,90.0,500"
    log = table(tmp_path / "f", names, f"{NOON},{row}", f"{NOON + 1.0},{row}")
    assert log.lla[0, 2] == pytest.approx(50.0)
    assert np.sqrt(log.covariance_n[0, 2, 2]) == pytest.approx(0.03)
    assert log.covariance_n[0, 0, 0] == pytest.approx(0.0002)
    assert log.velocity_n is not None and log.velocity_covariance_n is not None
    assert log.velocity_n[0, :2] == pytest.approx([0.0, 10.0], abs=1e-9)
    assert log.velocity_covariance_n[0, 0, 0] == pytest.approx(0.25 / 3.0)


@pytest.mark.parametrize("rate", [5, 20, 50])
@pytest.mark.parametrize(("name", "unit"), [("time_ms", 1e3), ("time [us]", 1e6), ("time", 1e3)])
def test_a_clock_s_unit_is_that_of_its_name_or_makes_it_a_date(
    tmp_path: Path, rate: int, name: str, unit: float
) -> None:
    rows = [f"{round((NOON + k / rate) * unit)},{THERE}" for k in range(90)]

    log = table(tmp_path / "f", f"{name},{PLACE}", *rows)

    assert log.t[[0, -1]].tolist() == pytest.approx([NOON, NOON + 89 / rate], abs=1e-3)


@pytest.mark.parametrize("name", ["course [rad]", "course_rad"])
def test_a_course_in_radians(tmp_path: Path, name: str) -> None:
    rows = [f"{t},{THERE},10.0,1.5707963,0.5" for t in (NOON, NOON + 1.0)]
    log = table(tmp_path / "f", f"time,{PLACE},speed,{name},sAcc", *rows)
    assert log.velocity_n is not None
    assert log.velocity_n[0, :2] == pytest.approx([0.0, 10.0], abs=1e-6)


@pytest.mark.parametrize(
    ("header", "first"),
    [("date;time", "15.11.2023;12:00:00,50"), ("time", "2023-11-15T12:00:00.500Z")],
)
def test_decimal_commas_beside_points(tmp_path: Path, header: str, first: str) -> None:
    rows = [f"{words};32,1;34,8;50,5" for words in (first, first.replace("00:00", "00:01"))]

    log = table(tmp_path / "f", f"{header};lat;lon;height", *rows)

    assert log.t.tolist() == [NOON + 0.5, NOON + 1.5]
    assert log.lla[0] == pytest.approx([*np.radians([32.1, 34.8]), 50.5])


@pytest.mark.parametrize(
    ("names", "row"),
    [
        ("height [ft],speed (ft/s)", "164.041995,32.808399"),
        ("height_ft,speed_fps", "164.041995,32.808399"),
        ("altitude (feet),speed [mph]", "164.041995,22.369363"),
    ],
)
def test_feet_and_miles_per_hour(tmp_path: Path, names: str, row: str) -> None:
    rows = [f"{t},32.1,34.8,{row},90.0,0.5" for t in (NOON, NOON + 1.0)]
    log = table(tmp_path / "f", f"time,lat,lon,{names},course,sAcc", *rows)
    assert log.lla[0, 2] == pytest.approx(50.0)
    assert log.velocity_n is not None
    assert log.velocity_n[0, :2] == pytest.approx([0.0, 10.0], abs=1e-6)


@pytest.mark.parametrize(("names", "told"), [("lat,lon", True), ("lat_rad,lon_rad", False)])
def test_degrees_that_may_be_radians_are_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, names: str, told: bool
) -> None:
    rows = [f"{t},0.56,0.61,50.0" for t in (NOON, NOON + 1.0)]
    check_positions(table(tmp_path / "f", f"time,{names},height", *rows))
    assert ("lat_rad" in caplog.text) is told


@pytest.mark.parametrize(
    ("header", "row", "height"),
    [
        ("time;lat;lon;height", f"{NOON:.0f};32,1;34,8;50,0", 50.0),
        ("time,lat,lon,height", f"{NOON},32.1N,34.8 E,50.0", 50.0),
        ("time,lat,lon,hMSL,geoid_sep", f"{NOON},32.1,34.8,30.0,20.0", 50.0),
        ("time,lat,lon,hMSL", f"{NOON},32.1,34.8,30.0", 30.0),
        ("time,lat,lon", f"{NOON},32.1,34.8", np.nan),
    ],
)
def test_positions(tmp_path: Path, header: str, row: str, height: float) -> None:
    log = table(tmp_path / "f", header, row, row.replace("9600", "9601", 1))
    assert np.degrees(log.lla[0, :2]) == pytest.approx([32.1, 34.8])
    assert log.lla[0, 2] == pytest.approx(height, nan_ok=True)


POS = (
    "% program : RTKLIB\n%  {} latitude({}) longitude({}) height(m) Q ns sdn(m) sde(m) sdu(m) {}\n"
)


def test_solutions_in_japanese_time_and_in_minutes(tmp_path: Path) -> None:
    path = tmp_path / "s.pos"
    rest = "sdne(m) sdeu(m) sdun(m) age(s) ratio"
    row = "2023/11/15,21:00:00.000,32.1,34.8,50.0,1,12,0.1,0.2,0.3,0,0,0,0.0,9.9\n"
    path.write_text(POS.format("JST", "deg", "deg", rest).replace(" ", ",") + row)
    assert rtklib.read_gnss(path).t.tolist() == [NOON]
    path.write_text(POS.format("GPST", "d'\"", "d'\"", rest) + row)
    with pytest.raises(InputError, match="out-outdegform=deg"):
        rtklib.read_gnss(path)


@cache
def drive(duration: float = 60.0) -> tuple[ImuLog, GnssLog]:
    """Return logs of a drive with turns and changes of speed, of one clock."""
    times = np.arange(0.4, duration - 1.0, 0.2)
    seen = scene(motions.car_drive(duration, seed=3), seed=3, fix_times=times)
    imu = ImuLog(Path("imu"), NOON + seen.t, seen.force @ FLIP, seen.rate @ FLIP, True)
    std = np.full((len(times), 3), 0.1)
    status = np.zeros(len(times), np.int8)
    return imu, GnssLog(Path("gnss"), NOON + times, seen.fix_lla, diagonal(std), status)


def iso(t: float) -> str:
    return f"{np.datetime64(round(t * 1e6), 'us')}"


def row_of(imu: ImuLog, k: int, rate_first: bool = False) -> str:
    parts = [imu.specific_force[k], imu.angular_rate[k]]
    return ",".join(f"{x:.6f}" for part in parts[:: -1 if rate_first else 1] for x in part)


NAMES = "ax,ay,az,gx,gy,gz"
FORMS: dict[str, tuple[str, Callable[[ImuLog, int], str]]] = {
    "ISO 8601": ("time," + NAMES, lambda imu, k: f"{iso(imu.t[k])}Z,{row_of(imu, k)}"),
    "date and time": (
        "date,time," + NAMES,
        lambda imu, k: f"{iso(imu.t[k]).replace('T', ',')},{row_of(imu, k)}",
    ),
    "week and seconds": (
        "week,tow," + NAMES,
        lambda imu, k: f"2288,{imu.t[k] - NOON + 302_418.0:.4f},{row_of(imu, k)}",
    ),
    "rates first, no names": ("", lambda imu, k: f"{imu.t[k]:.3f},{row_of(imu, k, True)}"),
    "count of the rows": ("", lambda imu, k: f"{k},{imu.t[k]:.3f},{row_of(imu, k)}"),
    "a word": ("t,name," + NAMES, lambda imu, k: f"{imu.t[k]:.3f},imu0,{row_of(imu, k)}"),
    "decimal commas": (
        "",
        lambda imu, k: f"{imu.t[k]:.3f},{row_of(imu, k)}".replace(",", ";").replace(".", ","),
    ),
}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_tables_of_an_imu(tmp_path: Path, form: str, encoding: str) -> None:
    imu, _ = drive(5.0)
    header, row = FORMS[form]
    path = tmp_path / "imu.csv"
    lines = ([header] if header else []) + [row(imu, k) for k in range(len(imu.t))]
    path.write_text("\n".join(lines) + "\n", encoding=encoding)

    assert formats.format_of(path) is imu_text
    log = imu_text.read_imu(path)

    assert log.is_dated
    assert log.t == pytest.approx(imu.t, abs=2e-3)
    assert log.specific_force == pytest.approx(imu.specific_force, abs=1e-6)
    assert log.angular_rate == pytest.approx(imu.angular_rate, abs=1e-6)


@pytest.mark.parametrize("degrees", [-90.0, 0.0, 90.0, 180.0])
def test_a_turned_imu_is_seen(degrees: float, caplog: pytest.LogCaptureFixture) -> None:
    # GIVEN an IMU whose x axis points to the left of the direction of travel by an angle
    imu, gnss = drive()
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    C = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    turned = replace(
        imu, specific_force=imu.specific_force @ C.T, angular_rate=imu.angular_rate @ C.T
    )
    # WHEN its accelerations are compared with the receiver's motion, THEN they show it
    yaw = mount_yaw(turned, gnss)
    assert yaw is not None
    assert abs(np.angle(np.exp(1j * (yaw - np.radians(degrees))))) < np.radians(3.0)
    check_imu(turned, gnss)
    assert ("direction of travel" in caplog.text) == (degrees != 0.0)


def test_a_flight_shows_no_direction_of_travel() -> None:
    times = np.arange(0.4, 59.0, 0.2)
    seen = scene(motions.quadrotor_flight(60.0, seed=3), seed=3, fix_times=times)
    imu = ImuLog(Path("imu"), NOON + seen.t, seen.force @ FLIP, seen.rate @ FLIP, True)
    std = diagonal(np.full((len(times), 3), 0.1))
    gnss = GnssLog(Path("gnss"), NOON + times, seen.fix_lla, std, np.zeros(len(times), np.int8))
    assert mount_yaw(imu, gnss) is None


def test_missing_gravity_is_seen(caplog: pytest.LogCaptureFixture) -> None:
    imu, gnss = drive()
    check_imu(replace(imu, specific_force=imu.specific_force - [0.0, 0.0, 9.8]), gnss)
    assert "gravity is missing" in caplog.text


def test_loops_and_rolls_are_no_missing_gravity(caplog: pytest.LogCaptureFixture) -> None:
    # GIVEN an aircraft that hangs upside down for a second less than it stands upright
    imu, gnss = drive(60.0)
    is_inverted = (imu.t - imu.t[0]) % 20.0 < 9.5
    force = np.where(is_inverted[:, None], -imu.specific_force, imu.specific_force)
    assert np.linalg.norm(force.mean(axis=0)) < 1.0
    # WHEN gravity is looked for, THEN it is there, and no mount is asked for
    check_imu(replace(imu, specific_force=force), gnss)
    assert "specific force" not in caplog.text and "gravity" not in caplog.text


@pytest.mark.parametrize(("ahead", "is_seen"), [(0.0, False), (18.0, True)])
def test_gps_time_in_one_of_the_logs_is_seen(
    ahead: float, is_seen: bool, caplog: pytest.LogCaptureFixture
) -> None:
    imu, gnss = drive(90.0)
    check_clocks(replace(imu, t=imu.t + ahead), gnss)
    assert ("GPS time" in caplog.text) == is_seen


@pytest.mark.parametrize(("factor", "is_seen"), [(1.0, False), (3.6, True), (100.0, True)])
def test_a_velocity_in_another_unit_is_seen(
    factor: float, is_seen: bool, caplog: pytest.LogCaptureFixture
) -> None:
    _, gnss = drive()
    metres = (gnss.lla - gnss.lla[0]) * [6.36e6, 6.37e6 * np.cos(gnss.lla[0, 0]), -1.0]
    check_velocity(replace(gnss, velocity_n=factor * np.gradient(metres, gnss.t, axis=0)))
    assert ("check its unit" in caplog.text) == is_seen


def test_a_wandering_position_at_rest_is_no_other_unit(caplog: pytest.LogCaptureFixture) -> None:
    # GIVEN a receiver at rest, whose position comes into place by 30 m within its claims
    _, gnss = drive()
    metres = 30.0 * np.exp(-(gnss.t - gnss.t[0]) / 15.0)
    lla = gnss.lla[0] + metres[:, None] * [1.0 / 6.36e6, 0.0, 0.0]
    std = diagonal(np.full((len(lla), 3), 10.0))
    still = replace(gnss, lla=lla, covariance_n=std, velocity_n=np.full((len(lla), 3), 0.05))
    # WHEN the velocity is compared with the positions, THEN they are no contradiction
    check_velocity(still)
    assert not caplog.text


def imu_file(path: Path, imu: ImuLog) -> Path:
    np.savetxt(path, np.column_stack((imu.t, imu.specific_force, imu.angular_rate)), delimiter=",")
    return path


def fix_file(path: Path, gnss: GnssLog, names: str = "time,lat,lon,height") -> Path:
    rows = np.column_stack((gnss.t, np.degrees(gnss.lla[:, :2]), gnss.lla[:, 2]))
    np.savetxt(path, rows, "%.9f", delimiter=",", header=names, comments="")
    return path


def test_fixes_without_height_become_a_bag(tmp_path: Path) -> None:
    imu, gnss = drive(10.0)
    flat = fix_file(tmp_path / "flat.csv", gnss, "time,lat,lon,depth")
    convert_logs([imu_file(tmp_path / "imu.csv", imu), flat], tmp_path / "out.mcap")
    with BagReader(tmp_path / "out.mcap") as bag:
        fix = next(message for _, _, message in bag.messages("/gnss/fix"))
    assert np.isnan(fix.altitude)


@pytest.mark.parametrize(
    ("names", "lacks"),
    [
        ("time,distance,speed,pitch,roll,height,north,east,down", "up (or latitude and longitude)"),
        ("epoch_number,lat,lon,height,a,b,c,d,e", "time"),
        ("time,lat,b,c,d,e,f,g,h", "longitude"),
    ],
)
def test_a_table_of_fixes_that_lacks_a_column_is_no_bad_imu(
    tmp_path: Path, names: str, lacks: str
) -> None:
    imu, _ = drive(10.0)
    table = np.column_stack((np.arange(20.0), *np.random.default_rng(0).normal(size=(8, 20))))
    fixes = tmp_path / "GT.csv"
    np.savetxt(fixes, table, delimiter=",", header=names, comments="")

    with pytest.raises(InputError) as raised:
        formats.read_logs([imu_file(tmp_path / "imu.csv", imu), fixes])
    assert (
        f"GT.csv: is no table of an IMU, and to be one of fixes it lacks a column for {lacks}"
        in (str(raised.value))
    )


def test_a_receivers_file_beside_an_autopilots_log(tmp_path: Path) -> None:
    # GIVEN a telemetry log with IMU and fixes, and a solution of the receiver's own
    mavlink = pytest.importorskip("pymavlink.dialects.v20.ardupilotmega")
    link = mavlink.MAVLink(None)
    imu = [
        mavlink.MAVLink_raw_imu_message(1_000_000 + 10_000 * k, 0, 0, -1000, 0, 0, 0, 0, 0, 0)
        for k in range(200)
    ]
    place = (321_000_000, 348_000_000, 70_000)
    fixes = [mavlink.MAVLink_gps_raw_int_message(1_010_000, 6, *place, 80, 90, 200, 9000, 12)]
    stamp = round(NOON * 1e6).to_bytes(8, "big")
    log = tmp_path / "flight.tlog"
    content = b"".join(stamp + message.pack(link) for message in [*imu, *fixes])
    log.write_bytes(content)
    _, gnss = drive(10.0)
    solution = fix_file(tmp_path / "fixes.csv", gnss)
    # WHEN both are read, THEN the fixes are those of the solution
    found_imu, found = formats.read_logs([log, solution])
    assert (found_imu.path, found.path) == (log, solution)
    # AND a log that is cut is read up to there
    log.write_bytes(content[:-5])
    assert len(ardupilot.read_imu(log).t) in (199, 200)


def test_a_receivers_stream_that_begins_amid_a_message(tmp_path: Path) -> None:
    pyubx2 = pytest.importorskip("pyubx2")
    values = {"year": 2023, "month": 11, "day": 15, "hour": 12, "validDate": 1, "validTime": 1}
    messages = [
        pyubx2.UBXMessage(
            "NAV", "NAV-PVT", pyubx2.GET, iTOW=1000 * k, fixType=3, lat=32.1, lon=34.8, **values
        ).serialize()
        for k in range(4)
    ]
    path = tmp_path / "r.ubx"
    cut_sentence = b"$GNGGA,120000.00,\xfe\xff\r\n"
    path.write_bytes(messages[0][37:] + messages[1] + cut_sentence + messages[2] + messages[3])
    assert formats.format_of(path) is ubx
    log = ubx.read_gnss(path)
    assert len(log.t) >= 2
    assert set(log.status.tolist()) == {FIX}


def test_options_between_the_files_and_options_that_do_not_apply(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    imu, gnss = drive(10.0)
    files = [imu_file(tmp_path / "imu.csv", imu), fix_file(tmp_path / "fixes.csv", gnss)]
    logs, out = [str(path) for path in files], str(tmp_path / "out.mcap")
    assert convert.main([*logs, "--time-offset", "0.5", out]) == 0
    assert convert.main([*logs, out, "--overwrite", "--gnss-rate", "1"]) == 2
    assert "--gnss-rate is for a folder of CSV files" in capsys.readouterr().err
    assert convert.main([logs[0], out, str(tmp_path / "other.mcap")]) == 2
    assert "is a bag already" in capsys.readouterr().err
    assert convert.main([*logs, str(tmp_path / "folder")]) == 0
    assert convert.main([str(tmp_path / "folder"), str(tmp_path / "other.mcap")]) == 2
    assert "is a bag already" in capsys.readouterr().err


def test_a_date_that_no_stamp_holds_is_refused(tmp_path: Path) -> None:
    imu, gnss = drive(10.0)
    late = fix_file(tmp_path / "f.csv", replace(gnss, t=gnss.t + 1e9 + GPS_EPOCH))
    with pytest.raises(InputError, match="stamps end in 2038"):
        convert_logs([imu_file(tmp_path / "imu.csv", imu), late], tmp_path / "out.mcap")


@pytest.mark.parametrize(
    ("word", "status"),
    [
        ("Autonomous", FIX),
        ("Single Point", FIX),
        ("NARROW_INT", GBAS_FIX),
        ("INS_RTKFIXED", GBAS_FIX),
        ("PSRDIFF", SBAS_FIX),
    ],
)
def test_words_of_a_status_count_as_a_whole(tmp_path: Path, word: str, status: int) -> None:
    rows = [f"{NOON + k},{THERE},{word}" for k in range(2)]
    assert table(tmp_path / "a.csv", f"time,{PLACE},status", *rows).status.tolist() == [status] * 2


def test_milliseconds_at_the_beginning_of_a_week(tmp_path: Path) -> None:
    """GIVEN times below 604 800 in ms WHEN read THEN the steps between them show the unit."""
    rows = [f"2288,{300_000 + 200 * k},{THERE}" for k in range(10)]
    assert np.ptp(table(tmp_path / "a.csv", f"week,itow,{PLACE}", *rows).t) == pytest.approx(1.8)
    imu = tmp_path / "imu.csv"
    samples = [f"2288,{300_000 + 10 * k},0,0,9.8,0,0,0.0{k}" for k in range(20)]
    imu.write_text("\n".join(["week,itow,ax,ay,az,gx,gy,gz", *samples]) + "\n")
    assert np.ptp(imu_text.read_imu(imu).t) == pytest.approx(0.19)


def test_a_clock_of_the_day_goes_on_after_midnight(tmp_path: Path) -> None:
    clocks = [f"23:59:{59 + 0.1 * k:.1f}" for k in range(10)]
    clocks += [f"00:00:{0.1 * k:04.1f}" for k in range(10)]
    path = tmp_path / "imu.csv"
    rows = [f"{clock},0,0,9.8,0,0,0.0{k}" for k, clock in enumerate(clocks)]
    path.write_text("\n".join(["time,ax,ay,az,gx,gy,gz", *rows]) + "\n")

    assert np.diff(imu_text.read_imu(path).t) == pytest.approx([0.1] * 19)


def test_rows_whose_time_does_not_rise_are_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """GIVEN tables in which times stand still and go back WHEN read THEN these rows are told."""
    times = [0.0, 0.2, 0.4, 0.4, 0.3, 0.6, 0.8, 1.0, 1.2, 1.4, 1.6]
    log = table(tmp_path / "a.csv", f"time,{PLACE}", *(f"{NOON + t},{THERE}" for t in times))
    path = tmp_path / "imu.csv"
    samples = [f"{t},0,0,9.8,0.1,0.2,{k}" for k, t in enumerate(times)]
    path.write_text("\n".join(["time,ax,ay,az,gx,gy,gz", *samples]) + "\n")
    imu = imu_text.read_imu(path)

    assert len(log.t) == len(imu.t) == 9
    assert "a.csv: 2 of 11 fixes are left out, whose time does not rise" in caplog.text
    assert "imu.csv: 2 of 11 IMU samples are left out" in caplog.text
    assert "the first is number 4, at 0.400 s after 0.400 s" in caplog.text


def test_a_time_that_is_none_costs_no_other_row(tmp_path: Path) -> None:
    assert rising(tmp_path, np.array([np.nan, 1.0, np.nan, 2.0]), "rows").tolist() == [
        *(False, True, False, True)
    ]


def sentence(body: str) -> str:
    """Return a sentence of NMEA 0183 with its checksum."""
    return f"${body}*{reduce(xor, body.encode()):02X}\r\n"


def nmea_file(path: Path, *epochs: tuple[str, str], date_by: str = "RMC") -> Path:
    """Write fixes at times of day, with their date (ddmmyy) where that is not empty."""
    text = ""
    for clock, day in epochs:
        text += sentence(f"GNGGA,{clock},3206.0,N,03448.0,E,1,10,0.9,20.0,M,17.0,M,,")
        if day and date_by == "RMC":
            text += sentence(f"GNRMC,{clock},A,3206.0,N,03448.0,E,5.0,90.0,{day},,,A")
        elif day:
            text += sentence(f"GNZDA,{clock},{day[:2]},{day[2:4]},20{day[4:]},00,00")
    path.write_text(text)
    return path


def test_a_compressed_stream_with_empty_fields_is_read(tmp_path: Path) -> None:
    pytest.importorskip("pynmeagps")
    text = ""
    for clock in ("120000.00", "120001.00", "120002.00"):
        text += sentence(f"GNGGA,{clock},3206.0,N,03448.0,E,1,10,0.9,,M,17.0,M,,")
        text += sentence(f"GNGST,{clock},1.0,,,,2.0,3.0,")
        text += sentence(f"GNRMC,{clock},A,3206.0,N,03448.0,E,5.0,90.0,151123,,,A")
    packed = tmp_path / "log.nmea.gz"
    packed.write_bytes(gzip.compress(text.encode()))

    log = nmea.read_gnss(packed)

    assert len(log.t) == 3 and np.isnan(log.lla[:, 2]).all()
    assert np.sqrt(np.diag(log.covariance_n[0]))[:2] == pytest.approx([2.0, 3.0])


@pytest.mark.parametrize("date_by", ["RMC", "ZDA"])
def test_each_epoch_of_a_receivers_stream_has_its_own_date(tmp_path: Path, date_by: str) -> None:
    """GIVEN pauses over midnight and of days WHEN read THEN every time is that of its sentence."""
    pytest.importorskip("pynmeagps")
    epochs = [
        ("225800.00", ""),  # before the receiver gives the date
        ("225801.00", "101123"),
        ("225801.50", ""),
        ("000500.00", "111123"),  # after a pause
        ("235959.50", "111123"),
        ("000000.00", ""),
        ("130000.00", ""),  # resumed two days later
        ("130001.00", "141123"),
    ]

    log = nmea.read_gnss(nmea_file(tmp_path / "log.nmea", *epochs, date_by=date_by))

    assert [iso(t)[8:19] for t in log.t] == [
        *("10T22:58:00", "10T22:58:01", "10T22:58:01", "11T00:05:00", "11T23:59:59"),
        *("12T00:00:00", "14T13:00:00", "14T13:00:01"),
    ]


def converted(tmp_path: Path, gnss: GnssLog, imu: ImuLog, header: str, *given: str) -> str:
    """Convert a table of fixes, each with the same further words, and return what is told."""
    rows = [
        f"{t},{np.degrees(lat)},{np.degrees(lon)},{height},{given[k % len(given)]}"
        for k, (t, (lat, lon, height)) in enumerate(zip(gnss.t, gnss.lla, strict=True))
    ]
    fixes = tmp_path / "fixes.csv"
    fixes.write_text("\n".join([f"time,{PLACE},{header}", *rows]) + "\n")
    paths = [imu_file(tmp_path / "imu.csv", imu), fixes]
    return convert_logs(paths, tmp_path / "out.mcap", overwrite=True)


def test_an_axis_that_is_missing_costs_no_other(tmp_path: Path) -> None:
    """GIVEN deviations and velocities of horizontal axes alone THEN these are in the bag."""
    imu, gnss = drive(10.0)

    told = converted(tmp_path, gnss, imu, "sdn,sde,vn,ve,sdvn,sdve", "0.3,0.4,1.0,2.0,0.05,0.06")

    assert "left out" not in told
    with BagReader(tmp_path / "out.mcap") as bag:
        fix = next(message for _, _, message in bag.messages("/gnss/fix"))
        velocities = [message.twist for _, _, message in bag.messages("/gnss/velocity")]
    assert fix.position_covariance_type == 3
    # Of the vertical axis: as where a table has one horizontal accuracy alone.
    expected = np.array([0.16, 0.09, 1.5**2 * 0.125])
    assert np.diag(fix.position_covariance.reshape(3, 3)) == pytest.approx(expected)
    assert len(velocities) == len(gnss.t)
    assert velocities[0].twist.linear.x == 2.0
    assert np.isnan(velocities[0].twist.linear.z)
    variances = np.diag(velocities[0].covariance.reshape(6, 6))
    assert variances == pytest.approx([0.0036, 0.0025, 1e6, 1e6, 1e6, 1e6])


def test_what_lacks_a_horizontal_axis_is_counted(tmp_path: Path) -> None:
    imu, gnss = drive(10.0)

    told = converted(
        tmp_path, gnss, imu, "cov_nn,cov_ee,vn,ve,sdvn,sdve", *("1,,1,2,.1,.1", "1,1,1,2,,.1")
    )

    half = len(gnss.t) // 2
    assert f"{len(gnss.t) - half} of {len(gnss.t)} fixes lack the standard deviation" in told
    assert f"{half} of {len(gnss.t)} velocities are left out: they lack a horizontal" in told
    with BagReader(tmp_path / "out.mcap") as bag:
        kinds = [m.position_covariance_type for _, _, m in bag.messages("/gnss/fix")]
        assert bag.count("/gnss/velocity") == len(gnss.t) - half
    assert kinds[:4] == [0, 3, 0, 3]


def test_a_steady_gyroscope_shows_no_factor() -> None:
    """GIVEN two equal samples WHEN compared with the course THEN no number is made of them."""
    imu, gnss = drive(60.0)
    two = replace(
        imu,
        t=imu.t[[0, -1]],
        specific_force=imu.specific_force[[0, 0]],
        angular_rate=np.zeros((2, 3)),
    )
    with np.errstate(all="raise"):
        assert turn_factor(two, gnss) is None


def test_a_vehicle_that_leans_into_its_turns_has_right_rates() -> None:
    """GIVEN turns at 25 m/s with 50° of bank WHEN compared with the course THEN they agree."""
    _, fixes = drive(60.0)
    t = np.arange(0.0, 120.0, 0.02)
    speed, turn = 25.0, 0.5 * np.sign(np.sin(2.0 * np.pi * t / 40.0))
    course = np.cumsum(turn) * 0.02
    bank = np.arctan2(speed * turn, 9.80665)
    force = np.column_stack([0.0 * t, 0.0 * t, 9.80665 / np.cos(bank)])
    rate = np.column_stack([0.0 * t, turn * np.sin(bank), turn * np.cos(bank)])
    imu = ImuLog(Path("imu"), NOON + t, force, rate, True)
    at = slice(0, None, 10)
    north, east = (np.cumsum(speed * f(-course)) * 0.02 for f in (np.cos, np.sin))
    count = len(t[at])
    place = np.tile(fixes.lla[0], (count, 1))
    place[:, 0] += north[at] / 6.37e6
    place[:, 1] += east[at] / (6.37e6 * np.cos(fixes.lla[0, 0]))
    covariance = diagonal(np.full((count, 3), 0.1))
    gnss = GnssLog(Path("gnss"), NOON + t[at], place, covariance, np.zeros(count, np.int8))

    assert turn_factor(imu, gnss) == pytest.approx(1.0, abs=0.1)
