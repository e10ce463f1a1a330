"""Logs of receivers, autopilots and IMUs: each format from a file that the test writes."""

from __future__ import annotations

import contextlib
import gzip
import struct
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from hybrid_ins.bags.reader import BagReader
from hybrid_ins.core.inertial.earth import C_en, LocalFrame, lla_to_ecef
from hybrid_ins.dataset.convert_logs import convert_logs
from hybrid_ins.dataset.logs import ardupilot, formats, gnss_text, imu_text, nmea, rtklib, ubx, ulog
from hybrid_ins.dataset.logs.clock_match import clock_offset
from hybrid_ins.dataset.logs.plausibility import check_imu, turn_factor
from hybrid_ins.dataset.logs.series import (
    FIX,
    GBAS_FIX,
    GPS_EPOCH,
    NO_FIX,
    SBAS_FIX,
    GnssLog,
    ImuLog,
    diagonal,
    utc_from_gps,
)
from hybrid_ins.errors import InputError
from hybrid_ins.ros.messages.conversions import stamp_ns

NOON = 1_700_049_600.0  # 2023-11-15T12:00:00Z
LLA = (np.radians(32.1), np.radians(34.8), 50.0)
POS_HEADER = (
    "% program   : RTKLIB\n"
    "%  GPST            latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m) sdne(m) "
    "sdeu(m) sdun(m) age(s) ratio vn(m/s) ve(m/s) vu(m/s) sdvn sdve sdvu sdvne sdveu sdvun\n"
)
POS_ROW = (
    "{} 32.1 34.8 50.0 1 12 0.1 0.2 0.3 -0.05 0.04 0.03 0.0 9.9 1.0 2.0 3.0 0.4 0.5 0.6 0 0 0\n"
)


@pytest.mark.parametrize("time", ["2023/11/15 12:00:18.000", "2288 302418.000"])
def test_rtklib_solution(tmp_path: Path, time: str) -> None:
    path = tmp_path / "solution.pos"
    path.write_text(POS_HEADER + POS_ROW.format(time) + "2023/11/15 12:0")

    assert formats.format_of(path) is rtklib
    log = rtklib.read_gnss(path)

    assert log.t.tolist() == [NOON]  # GPS time is 18 s ahead of UTC
    assert log.lla[0] == pytest.approx(LLA)
    # NED: covariances with up change their sign, and the file has their square roots.
    expected = [[0.01, -0.0025, -0.0009], [-0.0025, 0.04, -0.0016], [-0.0009, -0.0016, 0.09]]
    assert log.covariance_n[0] == pytest.approx(np.array(expected))
    assert log.status.tolist() == [GBAS_FIX]
    assert log.velocity_n is not None and log.velocity_covariance_n is not None
    assert log.velocity_n[0].tolist() == [1.0, 2.0, -3.0]
    assert np.diag(log.velocity_covariance_n[0]) == pytest.approx([0.16, 0.25, 0.36])


def test_rtklib_solution_from_its_end_with_a_row_twice(tmp_path: Path) -> None:
    path = tmp_path / "backward.pos"
    rows = [POS_ROW.format(f"2288 30241{second}.000") for second in (9, 8, 8, 7)]
    path.write_text(POS_HEADER + "".join(rows))

    assert rtklib.read_gnss(path).t.tolist() == [NOON - 1.0, NOON, NOON + 1.0]


def test_rtklib_solution_in_earth_fixed_coordinates(tmp_path: Path) -> None:
    x, y, z = lla_to_ecef(np.array(LLA))
    C_ne = C_en(np.array(LLA)).T
    path = tmp_path / "solution.pos"
    path.write_text(
        "%  UTC   x-ecef(m) y-ecef(m) z-ecef(m) Q ns sdx(m) sdy(m) sdz(m) sdxy(m) sdyz(m) sdzx(m) "
        "age(s) ratio vx vy vz sdvx sdvy sdvz sdvxy sdvyz sdvzx\n"
        f"2023/11/15 12:00:00.000 {x:.4f} {y:.4f} {z:.4f} 2 9 0.1 0.2 0.3 -0.05 0.04 0.03 0 1 "
        "1 2 3 0.1 0.1 0.1 0 0 0\n"
    )

    log = rtklib.read_gnss(path)

    assert log.t.tolist() == [NOON]
    assert log.lla[0, :2] == pytest.approx(LLA[:2], abs=1e-10)
    assert log.lla[0, 2] == pytest.approx(LLA[2], abs=1e-3)
    P = np.array([[0.01, -0.0025, 0.0009], [-0.0025, 0.04, 0.0016], [0.0009, 0.0016, 0.09]])
    assert log.covariance_n[0] == pytest.approx(C_ne @ P @ C_ne.T)
    assert log.velocity_n is not None and log.velocity_covariance_n is not None
    assert log.velocity_n[0] == pytest.approx(C_ne @ [1.0, 2.0, 3.0])
    assert log.velocity_covariance_n[0] == pytest.approx(0.01 * np.eye(3))


@pytest.mark.parametrize(
    ("utc", "ahead"), [(362_793_599, 0), (362_793_600, 1), (1_483_228_799, 17), (NOON, 18)]
)
def test_gps_time_is_ahead_of_utc_by_the_leap_seconds(utc: float, ahead: int) -> None:
    assert utc_from_gps(utc + ahead - GPS_EPOCH) == utc


def table(path: Path, header: str, *rows: str) -> GnssLog:
    path.write_text(header + "\n" + "\n".join(rows) + "\n")
    assert formats.format_of(path) is gnss_text
    return gnss_text.read_gnss(path)


PLACE = "lat,lon,height"
THERE = "32.1,34.8,50.0"


@pytest.mark.parametrize(
    ("header", "row"),
    [
        ("time", "2023-11-15T12:00:00.000Z"),
        ("time [UTC]", "2023-11-15 12:00:00"),
        ("timestamp", f"{NOON:.3f}"),
        ("gps_week,tow", "2288,302418.000"),
        ("week,iTOW(ms)", "2288,302418000"),
        ("date,time", "2023/11/15,12:00:00.000"),
        ("GPS date;GPS time", "15.11.2023;12:00:18"),
        ("gpst(s)", f"{NOON - GPS_EPOCH + 18:.1f}"),
    ],
)
def test_times_of_a_table_of_fixes(tmp_path: Path, header: str, row: str) -> None:
    mark = ";" if ";" in row else ","
    later = row.replace("12:00:00", "12:00:01").replace("12:00:18", "12:00:19")
    later = later.replace("302418", "302419").replace(f"{NOON:.0f}", f"{NOON + 1:.0f}")
    later = later.replace(f"{NOON - GPS_EPOCH + 18:.0f}", f"{NOON - GPS_EPOCH + 19:.0f}")
    rows = [(words + "," + THERE).replace(",", mark) for words in (row, later)]

    log = table(tmp_path / "fixes.csv", (header + "," + PLACE).replace(",", mark), *rows)

    assert log.t.tolist() == [NOON, NOON + 1.0]
    assert log.is_dated


def test_a_receivers_own_clock_is_not_utc(tmp_path: Path) -> None:
    log = table(tmp_path / "fixes.csv", "t_ms," + PLACE, "7000," + THERE, "7200," + THERE)
    assert log.t.tolist() == [7.0, 7.2]
    assert not log.is_dated


def test_table_of_fixes_with_preamble_and_what_else_it_knows(tmp_path: Path) -> None:
    path = tmp_path / "fixes.csv"
    names = "sd_n[m],sd_e[m],sd_u[m],vn(m/s),ve(m/s),vu(m/s),sd_vn,sd_ve,sd_vu,fix_type"
    path.write_text(
        "# a receiver\nrecorded by somebody\n"
        f"timestamp,latitude (deg),longitude (deg),altitude (m),{names}\n"
        f"{NOON},{THERE},0.1,0.2,0.3,1,2,3,0.4,0.5,0.6,6\n"
        f"{NOON + 1},{THERE},0.1,0.2,0.3,1,2,3,0.4,0.5,0.6,4\n"
        f"{NOON + 2},{THERE},0.1,0.2,0.3,1,2,3,0.4,0.5,0.6,1\n"
        f"{NOON + 3},32.1,"
    )

    assert formats.format_of(path) is gnss_text
    log = gnss_text.read_gnss(path)

    assert log.lla[0] == pytest.approx(LLA)
    assert log.status.tolist() == [GBAS_FIX, SBAS_FIX]  # the third is no fix
    assert np.diag(log.covariance_n[0]) == pytest.approx([0.01, 0.04, 0.09])
    assert log.velocity_n is not None and log.velocity_covariance_n is not None
    assert log.velocity_n[0].tolist() == [1.0, 2.0, -3.0]
    assert np.diag(log.velocity_covariance_n[0]) == pytest.approx([0.16, 0.25, 0.36])


@pytest.mark.parametrize(
    ("name", "words", "expected"),
    [
        ("status", ["2", "0", "-1"], [GBAS_FIX, FIX]),
        ("quality", ["4", "2", "0"], [GBAS_FIX, SBAS_FIX]),
        ("Q", ["1", "5", "9"], [GBAS_FIX, FIX, FIX]),
        ("fix", ["RTK fixed", "DGPS", "no fix"], [GBAS_FIX, SBAS_FIX]),
        ("fix", ["1", "2", "3"], [FIX, FIX, FIX]),  # whose numbers?
    ],
)
def test_status_in_a_table_of_fixes(
    tmp_path: Path, name: str, words: list[str], expected: list[int]
) -> None:
    rows = [f"{NOON + k},{THERE},{word}" for k, word in enumerate(words)]
    log = table(tmp_path / "fixes.csv", f"time,{PLACE},{name}", *rows)
    assert log.status.tolist() == expected
    assert NO_FIX not in log.status


def test_covariances_and_accuracies_of_a_table_of_fixes(tmp_path: Path) -> None:
    rows = [f"{NOON + k},{THERE},0.01,0.04,0.09,0.001,0.002,0.003" for k in range(2)]
    names = "cov_nn,cov_ee,cov_uu,cov_ne,cov_eu,cov_nu"
    log = table(tmp_path / "fixes.csv", f"time,{PLACE},{names}", *rows)
    expected = [[0.01, 0.001, -0.003], [0.001, 0.04, -0.002], [-0.003, -0.002, 0.09]]
    assert log.covariance_n[0] == pytest.approx(np.array(expected))

    rows = [f"{NOON + k},{THERE},0.2,0.3,2.0,90" for k in range(2)]
    log = table(tmp_path / "fixes.csv", f"time,{PLACE},hacc,vacc,speed,course", *rows)
    assert np.diag(log.covariance_n[0]) == pytest.approx([0.02, 0.02, 0.09])
    assert log.velocity_n is not None
    assert log.velocity_n[0, :2] == pytest.approx([0.0, 2.0], abs=1e-12)

    log = table(tmp_path / "fixes.csv", f"time,{PLACE}", *(f"{NOON + k},{THERE}" for k in (0, 1)))
    assert np.isnan(log.covariance_n[0]).any()  # the node's default is used


def test_earth_fixed_and_local_tables_of_fixes(tmp_path: Path) -> None:
    x, y, z = lla_to_ecef(np.array(LLA))
    place = f"{x:.4f},{y:.4f},{z:.4f}"
    log = table(tmp_path / "a.csv", "time,X,Y,Z", *(f"{NOON + k},{place}" for k in (0, 1)))
    assert log.lla[0, :2] == pytest.approx(LLA[:2], abs=1e-10)

    path = tmp_path / "b.csv"
    path.write_text(f"time,east,north,up\n{NOON},3.0,4.0,5.0\n{NOON + 1},3.0,4.0,5.0\n")
    with pytest.raises(InputError, match="local coordinates: give their origin, --origin"):
        gnss_text.read_gnss(path)
    log = gnss_text.read_gnss(path, np.array(LLA))
    assert LocalFrame(np.array(LLA)).position(log.lla[0]) == pytest.approx([4.0, 3.0, -5.0])


def test_compressed_tables_are_read(tmp_path: Path) -> None:
    path = tmp_path / "fixes.csv.gz"
    with gzip.open(path, "wt") as stream:
        stream.write(f"time,{PLACE}\n{NOON},{THERE}\n{NOON + 1},{THERE}\n")
    assert formats.format_of(path) is gnss_text
    assert gnss_text.read_gnss(path).t.tolist() == [NOON, NOON + 1.0]


def sentence(body: str) -> str:
    checksum = 0
    for byte in body.encode():
        checksum ^= byte
    return f"${body}*{checksum:02X}\r\n"


def test_nmea(tmp_path: Path) -> None:
    pytest.importorskip("pynmeagps")
    path = tmp_path / "receiver.txt"
    path.write_text(
        sentence("GNRMC,120000.00,A,3206.00000,N,03448.00000,E,1.944,090.0,151123,,,A")
        + sentence("GNGGA,120000.00,3206.00000,N,03448.00000,E,4,12,0.8,30.0,M,20.0,M,,")
        + sentence("GNGST,120000.00,1.0,,,,0.01,0.02,0.03")
    )

    assert formats.format_of(path) is nmea
    log = nmea.read_gnss(path)

    assert log.t.tolist() == [NOON]
    assert log.lla[0] == pytest.approx(LLA)  # above the ellipsoid
    assert np.diag(log.covariance_n[0]) == pytest.approx([1e-4, 4e-4, 9e-4])
    assert log.status.tolist() == [GBAS_FIX]
    assert log.velocity_n is not None
    assert log.velocity_n[0, :2] == pytest.approx([0.0, 1.0], abs=1e-3)


def test_ubx(tmp_path: Path) -> None:
    pyubx2 = pytest.importorskip("pyubx2")
    path = tmp_path / "receiver.ubx"
    pvt = pyubx2.UBXMessage(
        "NAV",
        "NAV-PVT",
        pyubx2.GET,
        iTOW=302_418_000,
        year=2023,
        month=11,
        day=15,
        hour=12,
        validDate=1,
        validTime=1,
        fixType=3,
        carrSoln=2,
        lat=32.1,
        lon=34.8,
        height=50_000,
        hAcc=20,
        vAcc=30,
        sAcc=100,
        velN=1000,
        velE=2000,
        velD=-3000,
    )
    path.write_bytes(pvt.serialize() + b"\xb5\x62cut")

    assert formats.format_of(path) is ubx
    log = ubx.read_gnss(path)

    assert log.t.tolist() == [NOON]
    assert log.lla[0] == pytest.approx(LLA)
    assert np.diag(log.covariance_n[0]) == pytest.approx([2e-4, 2e-4, 9e-4])
    assert log.status.tolist() == [GBAS_FIX]
    assert log.velocity_n is not None
    assert log.velocity_n[0].tolist() == [1.0, 2.0, -3.0]


def ulog_file(path: Path, topic: str = "sensor_combined", velocity_valid: int = 1) -> None:
    """
    Write a ULog with two IMU samples and a fix, by the format's description.

    Sea level is 20 m above the ellipsoid, and the origin of the local position is above the sea.
    """

    def message(kind: bytes, body: bytes) -> bytes:
        return struct.pack("<Hc", len(body), kind) + body

    imu = {
        "sensor_combined": "float[3] gyro_rad;float[3] accelerometer_m_s2;",
        "vehicle_imu": "float[3] delta_angle;float[3] delta_velocity;uint32_t delta_angle_dt;"
        "uint32_t delta_velocity_dt;",
    }[topic]
    imu = f"{topic}:uint64_t timestamp;{imu}"
    gps = (
        "sensor_gps:uint64_t timestamp;double latitude_deg;double longitude_deg;"
        "double altitude_ellipsoid_m;double altitude_msl_m;float eph;float epv;"
        "float s_variance_m_s;float vel_n_m_s;float vel_e_m_s;float vel_d_m_s;"
        "uint8_t vel_ned_valid;uint8_t fix_type;"
    )
    parts = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0), message(b"B", bytes(40))]
    place = (
        "vehicle_local_position:uint64_t timestamp;double ref_lat;double ref_lon;float ref_alt;"
        "float x;float y;float z;float vx;float vy;float vz;uint8_t xy_valid;uint8_t xy_global;"
    )
    attitude = "vehicle_attitude:uint64_t timestamp;float[4] q;"
    parts += [message(b"F", text.encode()) for text in (imu, gps, place, attitude)]
    names = (topic, "sensor_gps", "vehicle_local_position", "vehicle_attitude")
    for number, name in enumerate(names):
        parts.append(message(b"A", struct.pack("<BH", 0, number) + name.encode()))
    for t_us in (1_000_000, 1_005_000):
        readings = struct.pack("<Q6f", t_us, 0.1, 0.2, 0.3, 1.0, 2.0, -9.8)
        if topic == "vehicle_imu":
            deltas = (0.1 * 5e-3, 0.2 * 5e-3, 0.3 * 5e-3, 4e-3, 8e-3, -9.8 * 4e-3)
            readings = struct.pack("<Q6fII", t_us, *deltas, 5000, 4000)
        parts.append(message(b"D", struct.pack("<H", 0) + readings))
    position, errors, velocity = (32.1, 34.8, 50.0, 30.0), (0.2, 0.3, 0.5), (1.0, 2.0, -3.0)
    fix = struct.pack("<Q4d6f2B", 1_002_000, *position, *errors, *velocity, velocity_valid, 6)
    parts.append(message(b"D", struct.pack("<H", 1) + fix))
    for t_us in (1_001_000, 1_005_000):
        moved = struct.pack("<2d7f2B", 32.1, 34.8, 30.0, 4.0, 3.0, -5.0, 1.0, 2.0, 3.0, 1, 1)
        parts.append(message(b"D", struct.pack("<HQ", 2, t_us) + moved))
    for t_us, turn in ((1_000_000, 0.0), (1_010_000, 1.0)):  # rad, about the down axis
        q = (np.cos(0.5 * turn), 0.0, 0.0, np.sin(0.5 * turn))
        parts.append(message(b"D", struct.pack("<HQ4f", 3, t_us, *q)))
    path.write_bytes(b"".join(parts))


@pytest.mark.parametrize("topic", ["sensor_combined", "vehicle_imu"])
def test_ulog(tmp_path: Path, topic: str) -> None:
    pytest.importorskip("pyulog")
    path = tmp_path / "flight.ulg"
    ulog_file(path, topic)

    imu, gnss = formats.read_logs([path])

    assert formats.format_of(path) is ulog
    assert imu.t.tolist() == pytest.approx([1.0, 1.005])
    assert imu.specific_force[0] == pytest.approx([1.0, -2.0, 9.8], rel=1e-6)  # FRD becomes FLU
    assert imu.angular_rate[0] == pytest.approx([0.1, -0.2, -0.3], rel=1e-6)
    assert gnss.t.tolist() == pytest.approx([1.002])
    assert gnss.lla[0] == pytest.approx(LLA)
    assert gnss.status.tolist() == [GBAS_FIX]
    assert np.diag(gnss.covariance_n[0]) == pytest.approx([0.02, 0.02, 0.09], rel=1e-5)


def test_a_receiver_without_velocities_has_none(tmp_path: Path) -> None:
    pytest.importorskip("pyulog")
    ulog_file(tmp_path / "flight.ulg", velocity_valid=0)

    _, gnss = formats.read_logs([tmp_path / "flight.ulg"])

    assert gnss.velocity_covariance_n is None or np.isnan(gnss.velocity_covariance_n).any()


def dataflash(path: Path, estimate: str = "XKF1", has_cores: bool = True) -> None:
    """Write a dataflash log with two IMU samples and a fix, by the format's description."""
    core, name_of_core = ("B", "C,") if has_cores else ("", "")
    formats_of = {  # type, format, columns
        "FMT": (128, "BBnNZ", "Type,Length,Name,Format,Columns"),
        "IMU": (129, "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
        "GPS": (130, "QBBIHLLefff", "TimeUS,I,Status,GMS,GWk,Lat,Lng,Alt,Spd,GCrs,VZ"),
        "GPA": (131, "QBfffff", "TimeUS,I,VDop,HAcc,VAcc,SAcc,Und"),
        "ORGN": (132, "QBLLe", "TimeUS,Type,Lat,Lng,Alt"),
        estimate: (
            133,
            f"Q{core}ccCfffffff",
            f"TimeUS,{name_of_core}Roll,Pitch,Yaw,VN,VE,VD,dPD,PN,PE,PD",
        ),
    }
    codes = {"n": "4s", "N": "16s", "Z": "64s", "L": "i", "e": "i", "c": "h", "C": "H"}

    def message(name: str, *values: object) -> bytes:
        kind, layout, _ = formats_of[name]
        return (
            b"\xa3\x95"
            + bytes([kind])
            + struct.pack("<" + "".join(codes.get(code, code) for code in layout), *values)
        )

    parts = [
        message(
            "FMT",
            kind,
            3 + struct.calcsize("<" + "".join(codes.get(code, code) for code in layout)),
            name.encode(),
            layout.encode(),
            columns.encode(),
        )
        for name, (kind, layout, columns) in formats_of.items()
    ]
    for t_us in (1_000_000, 1_020_000):
        parts.append(message("IMU", t_us, 0, 0.1, 0.2, 0.3, 1.0, 2.0, -9.8))
        parts.append(message("IMU", t_us, 1, 9.0, 9.0, 9.0, 9.0, 9.0, 9.0))
    fix = (321_000_000, 348_000_000, 7000, 2.0, 90.0, -3.0)
    parts.append(message("GPS", 1_010_000, 0, 6, 302_418_000, 2288, *fix))
    parts.append(message("GPA", 1_010_300, 0, 1.0, 0.2, 0.3, 0.5, 20.0))
    parts.append(message("ORGN", 1_000_000, 0, 321_000_000, 348_000_000, 7000))
    for t_us, yaw in ((1_001_000, 573), (1_005_000, 2865)):  # 0.01°
        moved = (1.0, 2.0, 3.0, 0.0, 4.0, 3.0, -5.0)
        parts.append(message(estimate, t_us, *([0] if has_cores else []), 0, 0, yaw, *moved))
        if has_cores:
            parts.append(message(estimate, t_us, 1, 0, 0, 9000, *(9.0 for _ in moved)))
    path.write_bytes(b"".join(parts))


def dataflash_text(path: Path) -> None:
    """Write the same as text, as ground stations do; values are in their units."""
    path.write_text(
        "FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns\n"
        "FMT, 129, 36, IMU, QBffffff, TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ\n"
        "FMT, 130, 41, GPS, QBBIHLLefff, TimeUS,I,Status,GMS,GWk,Lat,Lng,Alt,Spd,GCrs,VZ\n"
        "FMT, 131, 32, GPA, QBfffff, TimeUS,I,VDop,HAcc,VAcc,SAcc,Und\n"
        "IMU, 1000000, 0, 0.1, 0.2, 0.3, 1, 2, -9.8\n"
        "IMU, 1000000, 1, 9, 9, 9, 9, 9, 9\n"
        "GPS, 1010000, 0, 6, 302418000, 2288, 32.1, 34.8, 70, 2, 90, -3\n"
        "GPA, 1010300, 0, 1, 0.2, 0.3, 0.5, 20\n"
        "IMU, 1020000, 0, 0.1, 0.2, 0.3, 1, 2, -9.8\n"
    )


def telemetry(path: Path) -> None:
    """Write a telemetry log with two IMU samples and a fix."""
    from pymavlink.dialects.v20 import ardupilotmega as mavlink

    link = mavlink.MAVLink(None)
    messages = [
        mavlink.MAVLink_raw_imu_message(t_us, 102, 204, -1000, 100, 200, 300, 0, 0, 0)
        for t_us in (1_000_000, 1_020_000)
    ]
    messages.append(
        mavlink.MAVLink_gps_raw_int_message(
            1_010_000, 6, 321_000_000, 348_000_000, 70_000, 80, 90, 200, 9000, 12,
            alt_ellipsoid=50_000, h_acc=200, v_acc=300, vel_acc=500,
        )
    )  # fmt: skip
    stamp = struct.pack(">Q", round(NOON * 1e6))
    path.write_bytes(b"".join(stamp + message.pack(link) for message in messages))


def test_of_two_vehicles_in_a_telemetry_log_the_first_is_read(tmp_path: Path) -> None:
    pytest.importorskip("pymavlink")
    from pymavlink.dialects.v20 import ardupilotmega as mavlink

    alone, both = tmp_path / "alone.tlog", tmp_path / "both.tlog"
    telemetry(alone)
    other = mavlink.MAVLink_raw_imu_message(1_010_000, 0, 0, -2000, 0, 0, 0, 0, 0, 0)
    place = mavlink.MAVLink_gps_raw_int_message(
        1_005_000, 6, 330_000_000, 348_000_000, 70_000, 80, 90, 200, 9000, 12
    )
    stamp, link = struct.pack(">Q", round(NOON * 1e6)), mavlink.MAVLink(None, srcSystem=2)
    parts = stamp + place.pack(link), alone.read_bytes(), stamp + other.pack(link)
    both.write_bytes(b"".join(parts))

    imu, gnss = formats.read_logs([both])

    assert imu.t.tolist() == pytest.approx([1.0, 1.02])
    assert gnss.t.tolist() == pytest.approx([1.01])


@pytest.mark.parametrize(
    ("needed", "write"),
    [
        ("pyulog", ulog_file),
        ("pymavlink", dataflash),
        ("pymavlink", partial(dataflash, has_cores=False)),  # ArduPilot 4.0
        ("pymavlink", partial(dataflash, estimate="NKF1")),
    ],
)
def test_the_autopilots_own_estimate_is_there_for_comparison(
    needed: str, write: Callable[[Path], None], tmp_path: Path
) -> None:
    pytest.importorskip(needed)
    path = tmp_path / "log"
    write(path)

    estimate = formats.read_estimate(path)

    assert estimate is not None
    assert estimate.t.tolist() == pytest.approx([1.001, 1.005])
    position = LocalFrame(np.array(LLA)).position(estimate.lla[0])
    assert position == pytest.approx([4.0, 3.0, -5.0], abs=1e-5)
    assert estimate.velocity_n[0].tolist() == [1.0, 2.0, 3.0]
    yaw = 2.0 * np.arctan2(estimate.quat_xyzw[:, 2], estimate.quat_xyzw[:, 3])
    assert yaw == pytest.approx([0.1, 0.5], abs=2e-4)


@pytest.mark.parametrize("offset", [None, 1e-3])
def test_an_autopilots_log_becomes_one_bag_with_its_estimate(
    tmp_path: Path, offset: float | None
) -> None:
    pytest.importorskip("pyulog")
    path, out = tmp_path / "flight.ulg", tmp_path / "flight.mcap"
    ulog_file(path)
    assert "estimate on /autopilot/odometry" in convert_logs([path], out, time_offset=offset)
    with BagReader(out) as bag:
        imu = next(m for _, _, m in bag.messages("/imu/data"))
        counts = {topic: bag.count(topic) for topic in bag.topics}
        [(_, _, datum)] = bag.messages("/autopilot/datum")
        first = next(m for _, _, m in bag.messages("/autopilot/odometry"))
    assert counts["/imu/data"] == counts["/autopilot/odometry"] == 2
    later = stamp_ns(first.header.stamp) - stamp_ns(imu.header.stamp)
    assert later == pytest.approx(1_000_000, abs=1000)  # of one clock, whatever is added
    assert datum.altitude == pytest.approx(55.0, abs=1e-3)
    assert first.pose.pose.position.x == pytest.approx(0.0, abs=1e-6)
    assert first.twist.twist.linear.z == pytest.approx(-3.0, abs=1e-6)


@pytest.mark.parametrize("write", [dataflash, dataflash_text, telemetry])
def test_ardupilot(tmp_path: Path, write: Callable[[Path], None]) -> None:
    pytest.importorskip("pymavlink")
    path = tmp_path / "log"
    write(path)

    assert formats.format_of(path) is ardupilot
    imu, gnss = formats.read_logs([path])

    assert imu.t.tolist() == pytest.approx([1.0, 1.02])
    assert imu.specific_force[0] == pytest.approx([1.0, -2.0, 9.8], rel=1e-3)  # FRD becomes FLU
    assert imu.angular_rate[0] == pytest.approx([0.1, -0.2, -0.3], rel=1e-6)
    assert gnss.t.tolist() == pytest.approx([1.01])
    assert gnss.lla[0] == pytest.approx(LLA)  # above the ellipsoid
    assert gnss.status.tolist() == [GBAS_FIX]
    assert np.diag(gnss.covariance_n[0]) == pytest.approx([0.02, 0.02, 0.09], rel=1e-5)
    assert gnss.velocity_n is not None
    assert gnss.velocity_n[0, :2] == pytest.approx([0.0, 2.0], abs=1e-6)
    convert_logs([path], tmp_path / "out.mcap")
    with BagReader(tmp_path / "out.mcap") as bag:
        assert bag.count("/gnss/velocity") == 1  # of telemetry without a vertical component


@pytest.mark.parametrize(
    ("module", "needed", "content"),
    [
        (ulog, "pyulog", b"ULog\x01\x12\x35\x01"),
        (ardupilot, "pymavlink", b"\xa3\x95\x80\x80"),
        (ubx, "pyubx2", b"\xb5\x62\x01\x07"),
        (nmea, "pynmeagps", b"$GNGGA,120000.00,3206.0,N,03448.0,E,4,12,0.8,30.0,M,20.0,M,,*00"),
    ],
)
def test_a_missing_library_is_named(
    module: ModuleType, needed: str, content: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, needed, None)
    path = tmp_path / "log"
    path.write_bytes(content)
    with pytest.raises(InputError, match=f"need {needed}: pip install {needed}"):
        module.read_gnss(path)


@pytest.mark.parametrize(
    ("force", "rate", "unit_of_time"),
    [(1.0, 1.0, 1.0), (1 / 9.80665, np.degrees(1.0), 1e3), (1e3 / 9.80665, np.degrees(1.0), 1e6)],
    ids=["m/s², rad/s, s", "g, deg/s, ms", "mg, deg/s, us"],
)
@pytest.mark.parametrize("header", ["", "time,ax,ay,az,gx,gy,gz\n", "# recorded at home\n;;\n"])
def test_imu_table(
    tmp_path: Path, header: str, force: float, rate: float, unit_of_time: float
) -> None:
    path = tmp_path / "imu.csv"
    rng = np.random.default_rng(1)
    t = 5.0 + 0.01 * np.arange(200)
    f = [0.0, 0.0, 9.8] + 0.1 * rng.standard_normal((200, 3))
    w = rng.standard_normal((200, 3))
    table = np.column_stack((t * unit_of_time, f * force, w * rate))
    path.write_text(
        header + "\n".join(",".join(f"{x:.9g}" for x in row) for row in table) + "\n0.1,"
    )

    assert formats.format_of(path) is imu_text
    log = imu_text.read_imu(path)

    assert log.t == pytest.approx(t)
    assert log.specific_force == pytest.approx(f, rel=1e-6)
    assert log.angular_rate == pytest.approx(w, rel=1e-6, abs=1e-7)
    assert not log.is_dated


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("hello\n" * 20, "none of the known formats"),
        ("1,2,3,4,5,6,7\n" * 50, "no column increases"),
        ("".join(f"{k},55,55,55,1,1,1\n" for k in range(50)), "no three columns hold gravity"),
    ],
)
def test_what_is_no_log_is_refused_in_one_line(tmp_path: Path, text: str, told: str) -> None:
    path = tmp_path / "file.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=told) as caught:
        formats.read_logs([path])
    assert "\n" not in str(caught.value)


def test_damaged_tables_never_end_in_a_traceback(tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    names = f"date,time,{PLACE},sd_n,sd_e,sd_u,status\n"
    rows = (f"2023/11/15,12:00:{k:02d}.0,{THERE},0.1,0.2,0.3,fixed\n" for k in range(30))
    sound = (names + "".join(rows)).encode()
    path, read = tmp_path / "fixes.csv", 0
    for _ in range(200):
        damaged = bytearray(sound)
        for at in rng.integers(len(damaged), size=rng.integers(1, 40)):
            damaged[at] = rng.integers(256)
        path.write_bytes(damaged[: rng.integers(len(damaged))])
        with contextlib.suppress(InputError):
            if formats.format_of(path) is gnss_text:
                log = gnss_text.read_gnss(path)
                read += 1
                assert np.isfinite(log.lla[:, :2]).all()
    assert read > 50


def walk(offset: float) -> tuple[ImuLog, GnssLog]:
    """Return logs of a walk with turns, the IMU's clock ``offset`` behind."""
    rng = np.random.default_rng(3)
    t = np.arange(0.0, 120.0, 0.01)
    turn = 0.8 * np.sin(0.21 * t) * np.sin(0.037 * t**1.2)
    heading = np.cumsum(turn) * 0.01
    rate = np.column_stack((np.zeros_like(t), np.zeros_like(t), turn))
    rate += 0.05 * rng.standard_normal(rate.shape)
    force = [0.0, 0.0, 9.8] + 0.5 * rng.standard_normal(rate.shape)
    imu = ImuLog(Path("imu"), t - offset, force, rate, False)
    fixes = slice(0, None, 25)
    velocity = 1.4 * np.column_stack(
        (np.cos(-heading[fixes]), np.sin(-heading[fixes]), np.zeros(len(t[fixes])))
    )
    lla = np.array(LLA) + np.cumsum(velocity * 0.25, axis=0) * [1.57e-7, 1.85e-7, -1.0]
    return imu, GnssLog(
        Path("gnss"),
        NOON + t[fixes],
        lla,
        diagonal(np.full((len(lla), 3), 0.02)),
        np.full(len(lla), GBAS_FIX, np.int8),
        velocity,
        diagonal(np.full((len(lla), 3), 0.05)),
    )


def test_clock_offset_is_found_by_turns() -> None:
    imu, gnss = walk(37.4)
    found = clock_offset(imu, gnss)
    assert found.offset == pytest.approx(NOON + 37.4, abs=0.15)
    assert found.correlation > 0.8
    assert found.by == "the turns"


@pytest.mark.parametrize("has_velocity", [True, False])
def test_clock_offset_of_a_straight_drive_is_found_by_changes_of_speed(has_velocity: bool) -> None:
    # GIVEN a drive straight ahead that speeds up and brakes, an IMU turned by 40 deg in the car
    imu, gnss = walk(37.4)
    rng = np.random.default_rng(4)
    t = imu.t + 37.4
    steps = rng.standard_normal(40).cumsum()
    speed = np.interp(t, np.linspace(0.0, 120.0, 40), 8.0 + 3.0 * steps / np.abs(steps).max())
    force = np.zeros((len(t), 3))
    change = np.gradient(speed, t)
    force[:, 0], force[:, 1] = np.cos(0.7) * change, np.sin(0.7) * change
    force += [0.0, 0.2, 9.8] + 0.5 * rng.standard_normal(force.shape)
    imu = replace(imu, specific_force=force, angular_rate=0.05 * rng.standard_normal(force.shape))
    velocity = np.zeros((len(gnss.t), 3))
    velocity[:, 1] = np.interp(gnss.t - NOON, t, speed)
    lla = np.array(LLA) + np.cumsum(velocity * 0.25, axis=0) * [1.57e-7, 1.85e-7, -1.0]
    gnss = replace(gnss, lla=lla, velocity_n=velocity if has_velocity else None)
    # WHEN the clocks are compared
    found = clock_offset(imu, gnss)
    # THEN it is the changes of speed that show the offset
    assert found.by == "the changes of speed"
    assert found.offset == pytest.approx(NOON + 37.4, abs=0.3)


ODD = {
    "empty": b"",
    "a line": b"hello\n",
    "zeros": bytes(4096),
    "noise": bytes(np.random.default_rng(5).integers(0, 256, 4096, np.uint8)),
    "UTF-16": "time,ax,ay,az,gx,gy,gz\n1,0,0,9.8,0,0,0\n".encode("utf-16"),
    "a header": b"time,latitude,longitude,height\n",
    "no number": b"time,lat,lon,height\n" + b"x,nan,inf,\n" * 50,
    "one time": b"time,ax,ay,az,gx,gy,gz\n" + b"1.0,0.0,0.0,9.8,0.0,0.0,0.0\n" * 50,
}


@pytest.mark.parametrize("suffix", ["csv", "pos", "nmea", "ubx", "ulg", "bin", "tlog", "gz"])
@pytest.mark.parametrize("content", ODD)
def test_odd_files_are_refused_in_one_line(tmp_path: Path, suffix: str, content: str) -> None:
    odd, table = tmp_path / f"odd.{suffix}", tmp_path / "imu.csv"
    odd.write_bytes(ODD[content])
    table.write_text("".join(f"{k * 0.01:.2f},0,0,9.8,0,0,0\n" for k in range(500)))
    for paths in ([odd], [odd, table], [table, odd]):
        with pytest.raises(InputError) as refused:
            convert_logs(paths, tmp_path / "out.mcap")
        assert "\n" not in str(refused.value)
    assert not (tmp_path / "out.mcap").exists()


@pytest.mark.parametrize(
    ("factor", "told"),
    [
        (1.0, ""),
        (np.degrees(1.0), "by the course the rates are in deg/s: converted"),
        (np.radians(1.0), "by the course the rates are in rad/s: not converted"),
        (-1.0, "turns against the course"),
        (2.0, "turns 2"),
    ],
)
def test_wrong_units_and_signs_of_rates_are_seen(
    factor: float, told: str, caplog: pytest.LogCaptureFixture
) -> None:
    imu, gnss = walk(-NOON)
    found = check_imu(replace(imu, angular_rate=imu.angular_rate * factor), gnss)
    assert told in caplog.text
    assert bool(told) == bool(caplog.text)
    corrected = turn_factor(found, gnss)
    assert corrected is not None
    assert (0.7 < corrected < 1.4) == (factor not in (-1.0, 2.0))


@pytest.mark.parametrize(
    ("axes", "told"), [([0, 1, 2], ""), ([2, 1, 0], "not up"), ([0, 1, -3], "along +z")]
)
def test_wrong_axes_are_seen(axes: list[int], told: str, caplog: pytest.LogCaptureFixture) -> None:
    imu, gnss = walk(-NOON)
    turned = [-readings if axes[2] < 0 else readings[:, axes]
              for readings in (imu.specific_force, imu.angular_rate)]  # fmt: skip
    check_imu(replace(imu, specific_force=turned[0], angular_rate=turned[1]), gnss)
    assert told in caplog.text
    assert bool(told) == bool(caplog.text)


def test_straight_motion_shows_no_clock_offset() -> None:
    imu, gnss = walk(0.0)
    straight = GnssLog(
        gnss.path, gnss.t, gnss.lla, gnss.covariance_n, gnss.status, np.full_like(gnss.lla, 1.0)
    )
    with pytest.raises(InputError, match="give it with --time-offset"):
        clock_offset(imu, straight)


def test_two_logs_become_a_bag_with_the_receivers_own_deviations(tmp_path: Path) -> None:
    imu, gnss = walk(0.0)
    table = tmp_path / "imu.csv"
    rows = np.column_stack((imu.t, imu.specific_force, imu.angular_rate))
    np.savetxt(table, rows, delimiter=",")
    solution = tmp_path / "solution.pos"
    solution.write_text(
        POS_HEADER
        + "".join(
            f"2288 {302418.0 + t - NOON:.3f} {np.degrees(lla[0]):.9f} {np.degrees(lla[1]):.9f} "
            f"{lla[2]:.4f} 1 12 0.1 0.2 0.3 0 0 0 0.0 9.9 {v[0]:.4f} {v[1]:.4f} 0.0 0.4 0.5 0.6 "
            "0 0 0\n"
            for t, lla, v in zip(gnss.t, gnss.lla, gnss.velocity_n, strict=True)
        )
    )
    out = tmp_path / "walk.mcap"

    told = convert_logs([solution, table], out)

    assert "clock offset by the turns" in told
    with BagReader(out) as bag:
        assert abs(bag.imu().stamp_ns[0] * 1e-9 - NOON) < 0.15
        fixes = [message for _, _, message in bag.messages("/gnss/fix")]
        velocities = [message for _, _, message in bag.messages("/gnss/velocity")]
    assert len(fixes) == len(velocities) == len(gnss.t)
    assert fixes[0].status.status == GBAS_FIX
    assert np.diag(fixes[0].position_covariance.reshape(3, 3)) == pytest.approx([0.04, 0.01, 0.09])
    assert velocities[0].twist.twist.linear.y == pytest.approx(1.4, abs=1e-3)
