#!/usr/bin/env bash
# gpxpy 1.6.2, `simplify` of a track that goes past its end and comes back on the same line: it measures how far
# points are from the endless line through the first and the last point, not from the segment that replaces them.
# Its documentation names the Ramer-Douglas-Peucker algorithm and links the article on it, which discards points that
# are close to the line segment between the end points; shapely's `simplify` does so.
# Expected with max_distance 10 m of 1 km north and 600 m back: the turn stays, 1600 m remain, as with shapely.
# Seen: two points 400 m apart; the turn is 600 m from the simplified track, and 1200 m of the way are lost.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet gpxpy==1.6.2 numpy==2.4.6 shapely==2.1.2
"$work/venv/bin/python" - <<'PROGRAM'
import numpy as np
from gpxpy.gpx import GPXTrackPoint, GPXTrackSegment
from shapely import LineString, Point

METRES = 111_120.0  # per degree of latitude, to 0.5 %
LIMIT = 10.0
there_and_back = np.r_[np.arange(0, 1001, 20.0), np.arange(980, 399, -20.0)]

for name, east in (("straight back", np.zeros(len(there_and_back))),
                   ("back 3 m beside", np.where(np.arange(len(there_and_back)) > 50, 3.0, 0.0))):
    original = LineString(np.column_stack([east, there_and_back]))
    by_shapely = original.simplify(LIMIT, preserve_topology=False)
    segment = GPXTrackSegment([GPXTrackPoint(y / METRES, x / METRES) for x, y in original.coords])
    before = segment.length_2d()
    segment.simplify(max_distance=LIMIT)
    seen = LineString([(p.longitude * METRES, p.latitude * METRES) for p in segment.points])
    farthest = [max(one.distance(Point(p)) for p in original.coords) for one in (by_shapely, seen)]
    print(f"{name}: {before:.0f} m; shapely {by_shapely.length:.0f} m, {farthest[0]:.0f} m off at most; "
          f"gpxpy {segment.length_2d():.0f} m, {farthest[1]:.0f} m off at most, {len(segment.points)} points")
    assert abs(before - 1600) < 10 and abs(by_shapely.length - 1600) < 10 and farthest[0] <= LIMIT
    assert farthest[1] > 590 and abs(segment.length_2d() - 400) < 10
PROGRAM
