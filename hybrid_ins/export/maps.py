"""
Trajectories for maps and geographic tools: KML, GPX and GeoJSON, coloured by quality.

References
----------
.. [1] OGC KML 2.3, with ``gx:Track`` for time-stamped tracks.
.. [2] GPX 1.1 (topografix.com/GPX/1/1), with Garmin's TrackExtension for the colour.
.. [3] RFC 7946, GeoJSON; colours by Mapbox's simplestyle-spec, times as ``coordTimes``.
"""

from __future__ import annotations

import html
import json
import math
import re
from collections.abc import Iterator
from itertools import pairwise

from hybrid_ins.errors import InputError
from hybrid_ins.export.track import QUALITIES, Part, parts, utc
from hybrid_ins.ros.messages.trajectory import Trajectory

_Point = tuple[int, float, float, float]  # stamp [ns], latitude, longitude [deg], height [m]

_HEIGHTS = "Heights are above the WGS-84 ellipsoid."


def kml(trajectory: Trajectory, name: str) -> Iterator[str]:
    """
    Yield the lines of a KML file: a time-stamped track for every part of one quality.

    It is drawn on the ground: KML's own heights are above sea level, ours above the ellipsoid.
    """
    _need_datum(trajectory, name)
    yield '<?xml version="1.0" encoding="UTF-8"?>\n'
    yield (
        '<kml xmlns="http://www.opengis.net/kml/2.2" '
        'xmlns:gx="http://www.google.com/kml/ext/2.2">\n'
    )
    yield f"<Document><name>{_xml(name)}</name><description>{_HEIGHTS}</description>\n"
    for k, quality in enumerate(QUALITIES):
        colour = "ff" + quality.colour[4:6] + quality.colour[2:4] + quality.colour[0:2]
        yield (
            f'<Style id="q{k}"><IconStyle><scale>0</scale></IconStyle>'
            f"<LineStyle><color>{colour.lower()}</color><width>3</width></LineStyle></Style>\n"
        )
    for part in parts(trajectory):
        yield (
            f"<Placemark><name>{_xml(part.quality.name)}</name>"
            f"<styleUrl>#q{QUALITIES.index(part.quality)}</styleUrl>\n"
            "<gx:Track><altitudeMode>clampToGround</altitudeMode>\n"
        )
        for stamp_ns in part.stamp_ns.tolist():
            yield f"<when>{utc(stamp_ns)}</when>\n"
        for latitude, longitude, height in part.lat_lon_height.tolist():
            yield f"<gx:coord>{longitude:.9f} {latitude:.9f} {height:.3f}</gx:coord>\n"
        yield "</gx:Track></Placemark>\n"
    yield "</Document></kml>\n"


def gpx(trajectory: Trajectory, name: str) -> Iterator[str]:
    """Yield the lines of a GPX file: a time-stamped track for every part of one quality."""
    _need_datum(trajectory, name)
    yield '<?xml version="1.0" encoding="UTF-8"?>\n'
    yield (
        '<gpx version="1.1" creator="hybrid_ins" xmlns="http://www.topografix.com/GPX/1/1" '
        'xmlns:gpxx="http://www.garmin.com/xmlschemas/GpxExtensions/v3">\n'
    )
    yield f"<metadata><name>{_xml(name)}</name><desc>{_HEIGHTS}</desc></metadata>\n"
    for part in parts(trajectory):
        yield (
            f"<trk><name>{_xml(part.quality.name)}</name><extensions><gpxx:TrackExtension>"
            f"<gpxx:DisplayColor>{part.quality.garmin_colour}</gpxx:DisplayColor>"
            "</gpxx:TrackExtension></extensions><trkseg>\n"
        )
        for stamp_ns, latitude, longitude, height in _points(part):
            yield (
                f'<trkpt lat="{latitude:.9f}" lon="{longitude:.9f}"><ele>{height:.3f}</ele>'
                f"<time>{utc(stamp_ns)}</time></trkpt>\n"
            )
        yield "</trkseg></trk>\n"
    yield "</gpx>\n"


def geojson(trajectory: Trajectory, name: str) -> Iterator[str]:
    """
    Yield the lines of a GeoJSON file: a LineString for every part of one quality.

    It is a MultiLineString, cut at the antimeridian, where it crosses that; [3]_ section 3.1.9.
    """
    _need_datum(trajectory, name)
    yield '{"type": "FeatureCollection", "name": ' + json.dumps(name) + ', "features": [\n'
    separator = ""
    for part in parts(trajectory):
        lines = _cut_at_antimeridian(list(_points(part)))
        times = [[utc(point[0]) for point in line] for line in lines]
        coordinates = [
            [[round(p[2], 9), round(p[1], 9), round(p[3], 3)] for p in line] for line in lines
        ]
        is_whole = len(lines) == 1
        feature = {
            "type": "Feature",
            "properties": {
                "name": part.quality.name,
                "stroke": f"#{part.quality.colour}",
                "stroke-width": 3,
                "coordTimes": times[0] if is_whole else times,
            },
            "geometry": {
                "type": "LineString" if is_whole else "MultiLineString",
                "coordinates": coordinates[0] if is_whole else coordinates,
            },
        }
        yield separator + json.dumps(feature, ensure_ascii=False, allow_nan=False)
        separator = ",\n"
    yield "\n]}\n"


def _points(part: Part) -> Iterator[_Point]:
    for stamp_ns, (latitude, longitude, height) in zip(
        part.stamp_ns.tolist(), part.lat_lon_height.tolist(), strict=True
    ):
        yield stamp_ns, latitude, longitude, height


def _cut_at_antimeridian(points: list[_Point]) -> list[list[_Point]]:
    """Return lines of two points or more, each of which ends at the antimeridian it meets."""
    lines = [points[:1]]
    for before, after in pairwise(points):
        turn = after[2] - before[2]
        if abs(turn) > 180.0:
            edge = math.copysign(180.0, before[2])
            way = turn + 2.0 * edge
            share = (edge - before[2]) / way if way else 0.0
            stamp_ns = before[0] + round(share * (after[0] - before[0]))
            latitude = before[1] + share * (after[1] - before[1])
            height = before[3] + share * (after[3] - before[3])
            lines[-1].append((stamp_ns, latitude, edge, height))
            lines.append([(stamp_ns, latitude, -edge, height)])
        lines[-1].append(after)
    return [2 * line if len(line) == 1 else line for line in lines]


def _need_datum(trajectory: Trajectory, name: str) -> None:
    if trajectory.datum_lla is None:
        raise InputError(
            f"{name}: has no datum (topic /datum), so latitudes and longitudes are not known: "
            "export to .tum or .csv instead"
        )


def _xml(text: str) -> str:
    """Escape a text for XML, without the control characters that it cannot hold."""
    readable = re.sub(r"[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]", "�", text)
    return html.escape(readable, quote=False)
