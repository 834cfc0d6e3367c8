#!/usr/bin/env bash
# pyproj 3.7.2 (PROJ 9.5.1), heights of receivers (above the ellipsoid) to heights above the sea without a
# geoid's grid, of which the package has none: they are returned as they are, by default, without a
# warning. `only_best=True` is documented to make PROJ "error out" if the best transformation cannot be
# used. It does so for UTM with heights above the sea, and not for latitude and longitude with them.
# Expected of 100 m on Spain's east coast, where EGM96 lies 50 m above the ellipsoid: 50 m, or an error.
# Seen: 100 m by default; by only_best=True 100 m for latitude and longitude with EGM96 or EGM2008, and
# "inf" for UTM. allow_ballpark=False does raise an error in all of these.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet pyproj==3.7.2
export PROJ_NETWORK=OFF XDG_DATA_HOME="$work"
unset PROJ_DATA PROJ_LIB PROJ_ONLY_BEST_DEFAULT
"$work/venv/bin/python" - <<'PROGRAM'
import math
import warnings
from pyproj import Transformer
from pyproj.exceptions import ProjError

PLACE = (38.625473, -0.0005, 100.0)  # degrees, metres above the ellipsoid
TARGETS = {
    "latitude, longitude, EGM96": "EPSG:4326+5773",
    "latitude, longitude, EGM2008": "EPSG:4326+3855",
    "UTM zone 30, EGM96": "EPSG:32630+5773",
}
assert "to error out if the best" in " ".join(Transformer.from_crs.__doc__.split())

def height(target, **options):
    """The transformed height, or None for an error."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            return Transformer.from_crs("EPSG:4979", target, **options).transform(*PLACE)[2]
    except ProjError:
        return None

for name, target in TARGETS.items():
    plain, best, strict = (
        height(target, **options) for options in ({}, {"only_best": True}, {"allow_ballpark": False}))
    print(f"{PLACE[2]} m to {name}: by default {plain}, only_best=True {best}, allow_ballpark=False {strict}")
    assert plain == PLACE[2] and strict is None, (plain, strict)
    assert math.isinf(best) if "UTM" in name else best == PLACE[2], best
PROGRAM
