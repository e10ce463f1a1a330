"""Exported trajectories: what other tools read from them is what the estimate says."""

import csv
import json
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from support.recordings import (
    DATUM,
    FAST,
    TRUTH,
    bag,
    flight,
    navsatfix,
    run_program,
    stamps,
    with_sigma,
    write_track,
)

from hybrid_ins.core.inertial.earth import LocalFrame
from hybrid_ins.core.inertial.rotations import quat_from_rpy
from hybrid_ins.errors import InputError
from hybrid_ins.export.tables import COLUMNS
from hybrid_ins.export.writer import FORMATS, check_export, export, export_bag
from hybrid_ins.ros.messages.conversions import SWAP
from hybrid_ins.ros.messages.trajectory import Trajectory

KML = {"k": "http://www.opengis.net/kml/2.2", "gx": "http://www.google.com/kml/ext/2.2"}
GPX = {"g": "http://www.topografix.com/GPX/1/1"}
GARMIN = "{http://www.garmin.com/xmlschemas/GpxExtensions/v3}"


def worsening() -> Trajectory:
    """Return a flight with σ 0.2 m whose second half has 1 m."""
    good = with_sigma(flight(FAST), 0.2)
    assert good.position_cov is not None
    covariance = good.position_cov.copy()
    covariance[1000:] = np.eye(3)
    return replace(good, position_cov=covariance)


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def seconds(iso: str) -> float:
    return datetime.fromisoformat(iso.replace("Z", "+00:00")).timestamp()


def test_tum_holds_every_digit_of_time_and_pose(tmp_path: Path) -> None:
    odd = replace(flight([0.0, 1.0]), stamp_ns=stamps([0.0, 1.0]) + 123_456_789)

    export(odd, "run", tmp_path / "run.tum")

    lines = [line.split() for line in (tmp_path / "run.tum").read_text().splitlines()]
    assert [line[0] for line in lines] == ["1700000000.123456789", "1700000001.123456789"]
    assert odd.quat_xyzw is not None
    poses = np.array([line[1:] for line in lines], float)
    assert poses == pytest.approx(np.hstack((odd.position_enu, odd.quat_xyzw)), abs=1e-9)


def test_evo_reads_tum(tmp_path: Path) -> None:
    file_interface = pytest.importorskip("evo.tools.file_interface")
    export(flight(FAST), "run", tmp_path / "run.tum")

    read = file_interface.read_tum_trajectory_file(str(tmp_path / "run.tum"))

    assert read.num_poses == len(FAST)
    assert read.path_length == pytest.approx(200.0)


def test_csv_has_its_columns_units_and_axes(tmp_path: Path) -> None:
    export(worsening(), "run", tmp_path / "run.csv")

    table = rows(tmp_path / "run.csv")
    last = {name: float(value) for name, value in table[-1].items()}
    assert list(table[0]) == list(COLUMNS)
    assert len(table) == len(FAST)
    assert last["east_m"] == pytest.approx(200.0)
    assert last["velocity_east_mps"] == pytest.approx(10.0)
    assert last["sigma_up_m"] == pytest.approx(1.0)
    assert last["sigma_velocity_left_mps"] == pytest.approx(0.2)
    assert last["sigma_rotation_up_deg"] == pytest.approx(np.degrees(0.2), abs=1e-3)
    assert last["yaw_deg"] == pytest.approx(90.0)  # the nose is to the north
    assert last["heading_deg"] % 360.0 == pytest.approx(0.0, abs=1e-3)
    lla = [np.radians(last["latitude_deg"]), np.radians(last["longitude_deg"]), last["height_m"]]
    back = LocalFrame(DATUM).position(np.array(lla)) @ SWAP
    assert back == pytest.approx([200.0, 0.0, 0.0], abs=1e-3)


def test_csv_leaves_empty_what_is_not_known(tmp_path: Path) -> None:
    whole = flight([0.0, 1.0])

    export(Trajectory(whole.stamp_ns, whole.position_enu), "run", tmp_path / "run.csv")

    known = {name for name, value in rows(tmp_path / "run.csv")[1].items() if value}
    assert known == {"time_s", "east_m", "north_m", "up_m"}


def map_parts(path: Path) -> list[tuple[str, list[float], list[list[float]]]]:
    """Return colour, times and (longitude, latitude, height) of each part of a map file."""
    if path.suffix == ".geojson":
        features: list[Any] = json.loads(path.read_text(encoding="utf-8"))["features"]
        return [
            (
                f["properties"]["stroke"],
                [seconds(t) for t in f["properties"]["coordTimes"]],
                f["geometry"]["coordinates"],
            )
            for f in features
        ]
    root = ElementTree.parse(path).getroot()
    if path.suffix == ".gpx":
        return [
            (
                str(trk.find(f".//{GARMIN}DisplayColor").text),  # type: ignore[union-attr]
                [seconds(str(t.text)) for t in trk.findall(".//g:time", GPX)],
                [
                    [float(p.get("lon", "")), float(p.get("lat", "")), float(p[0].text or "")]
                    for p in trk.findall(".//g:trkpt", GPX)
                ],
            )
            for trk in root.findall("g:trk", GPX)
        ]
    colours = {
        f"#{s.get('id')}": str(s.find(".//k:color", KML).text)  # type: ignore[union-attr]
        for s in root.findall(".//k:Style", KML)
    }
    return [
        (
            colours[str(p.find("k:styleUrl", KML).text)],  # type: ignore[union-attr]
            [seconds(str(t.text)) for t in p.findall(".//k:when", KML)],
            [[float(v) for v in str(c.text).split()] for c in p.findall(".//gx:coord", KML)],
        )
        for p in root.findall(".//k:Placemark", KML)
    ]


@pytest.mark.parametrize(
    ("suffix", "colours"),
    [
        (".kml", ["ffe9b456", "ff009fe6"]),  # aabbggrr
        (".gpx", ["Cyan", "Yellow"]),
        (".geojson", ["#56B4E9", "#E69F00"]),
    ],
)
def test_maps_are_coloured_by_quality_and_stamped(
    tmp_path: Path, suffix: str, colours: list[str]
) -> None:
    path = tmp_path / f"run{suffix}"

    export(worsening(), "a & <b>\x07 run", path)

    first, second = map_parts(path)
    assert [first[0], second[0]] == colours
    # Ten points a second, and the line goes on from part to part.
    assert len(first[1]) == len(first[2]) == 100
    assert len(second[1]) == 102
    assert second[2][0] == first[2][-1]
    assert second[1][0] == first[1][-1]
    assert first[1][0] == pytest.approx(1_700_000_000.0)
    assert second[1][-1] == pytest.approx(1_700_000_020.0)
    longitude, latitude, height = second[2][-1]
    lla = np.array([np.radians(latitude), np.radians(longitude), height])
    assert LocalFrame(DATUM).position(lla) @ SWAP == pytest.approx([200.0, 0.0, 0.0], abs=2e-3)


@pytest.mark.parametrize("east", [1.0, -1.0])
def test_geojson_is_cut_at_the_antimeridian(tmp_path: Path, east: float) -> None:
    """A line from 180 to -180 degrees is drawn around the Earth; RFC 7946 cuts it."""
    whole = flight(FAST)
    at = whole.position_enu * [east, 1.0, 1.0] - [east * 100.5, 0.0, 0.0]
    crossing = replace(whole, position_enu=at, datum_lla=np.array([0.3, np.pi, 20.0]))

    export(crossing, "run", tmp_path / "run.geojson")

    (feature,) = json.loads((tmp_path / "run.geojson").read_text(encoding="utf-8"))["features"]
    assert feature["geometry"]["type"] == "MultiLineString"
    first, second = (np.array(line) for line in feature["geometry"]["coordinates"])
    assert np.all(east * first[:, 0] > 0.0) and np.all(east * second[:, 0] < 0.0)
    assert (first[-1, 0], second[0, 0]) == (east * 180.0, -east * 180.0)
    assert first[-1, 1:] == pytest.approx(second[0, 1:])
    times = feature["properties"]["coordTimes"]
    assert [len(times[0]), len(times[1])] == [len(first), len(second)]
    assert seconds(times[0][-1]) == seconds(times[1][0]) == pytest.approx(1.7e9 + 10.05, abs=2e-3)


def test_no_line_is_drawn_over_a_gap_and_unknown_quality_has_its_colour(tmp_path: Path) -> None:
    at = np.concatenate((np.arange(0.0, 5.0, 0.1), np.arange(9.0, 12.05, 0.1)))

    export(flight(at), "run", tmp_path / "run.geojson")

    first, second = map_parts(tmp_path / "run.geojson")
    assert first[0] == second[0] == "#8A8A8A"
    assert second[1][0] - first[1][-1] == pytest.approx(4.1)


@pytest.mark.parametrize("suffix", [".kml", ".gpx", ".geojson"])
def test_without_a_datum_there_is_no_map(tmp_path: Path, suffix: str) -> None:
    with pytest.raises(InputError, match="no datum"):
        export(replace(flight(TRUTH), datum_lla=None), "run", tmp_path / f"run{suffix}")

    assert list(tmp_path.iterdir()) == []


def test_without_attitude_there_is_no_tum(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no attitude.*\.csv"):
        export(replace(flight(TRUTH), quat_xyzw=None), "run", tmp_path / "run.tum")

    assert list(tmp_path.iterdir()) == []


def test_poses_of_a_heading_that_is_searched_for_are_in_no_tum(tmp_path: Path) -> None:
    # GIVEN an estimate whose heading is known from 5 s on, and one whose heading never is
    track = flight(TRUTH)
    covariance = np.tile(0.01 * np.eye(3), (len(track), 1, 1))
    covariance[:50, 2, 2] = 3.3
    found = replace(track, attitude_cov=covariance)

    export(found, "run", tmp_path / "run.tum")
    with pytest.raises(InputError, match=r"no attitude with a known heading.*\.csv"):
        export(found.rows(slice(50)), "run", tmp_path / "never.tum")

    assert len((tmp_path / "run.tum").read_text().splitlines()) == len(TRUTH) - 50


def test_a_heading_in_a_table_is_below_360_degrees(tmp_path: Path) -> None:
    track = flight([0.0, 1.0])
    quat = np.tile(quat_from_rpy(0.0, 0.0, np.radians(90.00001)), (2, 1))

    export(replace(track, quat_xyzw=quat), "run", tmp_path / "run.csv")

    assert [row["heading_deg"] for row in rows(tmp_path / "run.csv")] == ["0.0000"] * 2


def test_a_name_that_will_not_do_is_refused_before_the_work(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"\.tum, \.csv, \.kml, \.gpx, \.geojson"):
        check_export(tmp_path / "run.shp")
    with pytest.raises(InputError, match="lies in the input"):
        check_export(tmp_path / "in" / "run.csv", [tmp_path / "in"])


def test_a_bag_is_exported_and_the_program_does_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with bag(tmp_path / "run", flight(TRUTH)) as out:
        write_track(out, "/odometry", with_sigma(flight(FAST), 0.5))
        out.write("/datum", navsatfix(int(stamps(0.0)), DATUM), int(stamps(0.0)))
    options = [part for s in FORMATS for part in ("--export", tmp_path / f"run{s.upper()}")]

    export_bag(tmp_path / "run", tmp_path / "library.csv")
    text, _ = run_program(capsys, 0, tmp_path / "run", *options)
    _, error = run_program(capsys, 2, tmp_path / "run", "--export", tmp_path / "run" / "x.csv")

    assert all(f"trajectory: {tmp_path / f'run{s.upper()}'}" in text for s in FORMATS)
    assert (tmp_path / "run.CSV").read_bytes() == (tmp_path / "library.csv").read_bytes()
    assert "lies in the input" in error


def test_positions_before_the_heading_is_known_are_on_maps_and_in_tables(tmp_path: Path) -> None:
    # GIVEN an estimate whose heading is known from 5 s on
    with bag(tmp_path / "run") as out:
        write_track(out, "/odometry", with_sigma(flight(TRUTH), 0.5))
        write_track(out, "/odometry/local", flight(TRUTH[50:]), ("odom", "base_link"))
        out.write("/datum", navsatfix(int(stamps(0.0)), DATUM), int(stamps(0.0)))

    for suffix in FORMATS:
        export_bag(tmp_path / "run", tmp_path / f"run{suffix}")

    assert len(rows(tmp_path / "run.csv")) == len(TRUTH)
    for suffix in (".kml", ".gpx", ".geojson"):
        assert map_parts(tmp_path / f"run{suffix}")[0][1][0] == stamps(0.0) * 1e-9
    poses = (tmp_path / "run.tum").read_text().splitlines()
    assert len(poses) == len(TRUTH) - 50
