#!/usr/bin/env bash
# pymap3d 3.2.0, `departure` and `loxodrome_inverse` between longitudes on both sides of 180 degrees. `departure`,
# "the distance along a specific parallel between two meridians", takes the difference of longitudes modulo 180
# degrees, not 360: from 175 to -175 it is neither 10 (the short way) nor 350, but 170 degrees long.
# `loxodrome_inverse`, documented as "like Matlab distance('rh',...)", goes once around the Earth the other way.
# Expected, by the radius of the parallel, and by pymap3d itself where the second longitude is written as 185:
# 1089.0 km at 12 degrees of latitude. Seen: 18514 km. A recording that crosses 180 degrees (Fiji) gets that.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet pymap3d==3.2.0 numpy==2.4.6 pyproj==3.7.2
"$work/venv/bin/python" - <<'PROGRAM'
import numpy as np
from pymap3d.lox import departure, loxodrome_direct, loxodrome_inverse
from pyproj import Geod

LATITUDE, EAST, WEST = -12.0, 175.0, -175.0
fine = np.linspace(EAST, WEST + 360, 10001)
parallel = Geod(ellps="WGS84").line_length(fine, np.full(fine.shape, LATITUDE))  # short geodesics: independent
radius = parallel / np.radians(WEST + 360 - EAST)

across, same_places = departure(EAST, WEST, LATITUDE), departure(EAST, WEST + 360, LATITUDE)
print(f"along the parallel, km: {parallel / 1e3:.1f} by PROJ, {same_places / 1e3:.1f} to 185 E, "
      f"{across / 1e3:.1f} to 175 W")
assert abs(same_places - parallel) < 1
assert abs(across - radius * np.radians(170)) < 1

end = -11.0
length, azimuth = loxodrome_inverse(LATITUDE, EAST, end, WEST + 360)
seen, seen_azimuth = loxodrome_inverse(LATITUDE, EAST, end, WEST)
there = loxodrome_direct(LATITUDE, EAST, length, azimuth)
print(f"rhumb line to {-end:.0f} S: {length / 1e3:.1f} km towards {azimuth:.1f} degrees to 185 E, "
      f"{seen / 1e3:.1f} km towards {seen_azimuth:.1f} to 175 W; following the former ends at {np.round(there, 6)}")
assert np.allclose(there, (end, WEST + 360), atol=1e-4)
geodesic = Geod(ellps="WGS84").inv(EAST, LATITUDE, WEST, end)[2]
assert geodesic <= length < 1.01 * geodesic
assert seen > 30 * geodesic and 260 < seen_azimuth < 280
PROGRAM
