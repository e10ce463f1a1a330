"""Logs of receivers, autopilots and IMUs: each format from a file that the test writes."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from hybrid_ins.bags.reader import BagReader
from hybrid_ins.dataset.convert_logs import convert_logs
from hybrid_ins.dataset.logs import formats, imu_text, nmea, rtklib, ubx, ulog
from hybrid_ins.dataset.logs.clock_match import clock_offset
from hybrid_ins.dataset.logs.series import GBAS_FIX, GnssLog, ImuLog, diagonal
from hybrid_ins.errors import InputError

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


def ulog_file(path: Path) -> None:
    """Write a ULog with two IMU samples and a fix, by the format's description."""

    def message(kind: bytes, body: bytes) -> bytes:
        return struct.pack("<Hc", len(body), kind) + body

    imu = "sensor_combined:uint64_t timestamp;float[3] gyro_rad;float[3] accelerometer_m_s2;"
    gps = (
        "sensor_gps:uint64_t timestamp;double latitude_deg;double longitude_deg;"
        "double altitude_ellipsoid_m;float eph;float epv;float s_variance_m_s;float vel_n_m_s;"
        "float vel_e_m_s;float vel_d_m_s;uint8_t fix_type;"
    )
    parts = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0), message(b"B", bytes(40))]
    parts += [message(b"F", text.encode()) for text in (imu, gps)]
    for number, name in enumerate(("sensor_combined", "sensor_gps")):
        parts.append(message(b"A", struct.pack("<BH", 0, number) + name.encode()))
    for t_us in (1_000_000, 1_005_000):
        readings = struct.pack("<Q6f", t_us, 0.1, 0.2, 0.3, 1.0, 2.0, -9.8)
        parts.append(message(b"D", struct.pack("<H", 0) + readings))
    fix = struct.pack("<Q3d6fB", 1_002_000, 32.1, 34.8, 50.0, 0.2, 0.3, 0.5, 1.0, 2.0, -3.0, 6)
    parts.append(message(b"D", struct.pack("<H", 1) + fix))
    path.write_bytes(b"".join(parts))


def test_ulog(tmp_path: Path) -> None:
    pytest.importorskip("pyulog")
    path = tmp_path / "flight.ulg"
    ulog_file(path)

    imu, gnss = formats.read_logs([path])

    assert formats.format_of(path) is ulog
    assert imu.t.tolist() == pytest.approx([1.0, 1.005])
    assert imu.specific_force[0] == pytest.approx([1.0, -2.0, 9.8], rel=1e-6)  # FRD becomes FLU
    assert imu.angular_rate[0] == pytest.approx([0.1, -0.2, -0.3], rel=1e-6)
    assert gnss.t.tolist() == pytest.approx([1.002])
    assert gnss.lla[0] == pytest.approx(LLA)
    assert gnss.status.tolist() == [GBAS_FIX]
    assert np.diag(gnss.covariance_n[0]) == pytest.approx([0.02, 0.02, 0.09], rel=1e-5)


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
    offset, correlation = clock_offset(imu, gnss)
    assert offset == pytest.approx(NOON + 37.4, abs=0.15)
    assert correlation > 0.8


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
