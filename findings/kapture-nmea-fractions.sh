#!/usr/bin/env bash
# kapture 1.1.12, GNSS from NMEA files (`kapture_import_nmea`, `extract_gnss_from_nmea`): the digits after the
# point of a time are taken as milliseconds, however many there are. NMEA leaves their number to the receiver. With
# four, as some surveying receivers write them, hundredths become seconds. A time without a point is dropped, with
# a note in the debug log alone; and so is every sentence of a receiver of several systems ($GNGGA, $GNRMC), as
# nearly all are now.
# Expected of fixes at 0, .25, .5 and .75 s: these, by any number of digits. Seen with one to three digits: these;
# with four: 0, 2.5, 5 and 7.5 s; with six: 0 to 750 s; without a point and from GN: no fix at all.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet kapture==1.1.12 numpy==2.4.6 scipy==1.17.1
cd "$work"
"$work/venv/bin/python" - <<'PROGRAM'
from functools import reduce

from kapture.converter.nmea.import_nmea import extract_gnss_from_nmea

def sentence(text):
    return f"${text}*{reduce(lambda sum_, letter: sum_ ^ ord(letter), text, 0):02X}\n"

def seconds(talker, digits, times):
    """Times of the fixes after the first one, as they are read."""
    with open("track.nmea", "w") as file:
        for time in times:
            clock = f"{120000 + time:.{digits}f}"
            file.write(sentence(f"{talker}RMC,{clock},A,4807.0380,N,01131.0000,E,1.0,84.4,230326,,,A"))
            file.write(sentence(f"{talker}GGA,{clock},4807.0380,N,01131.0000,E,4,12,0.7,545.4,M,46.9,M,,"))
    stamps = sorted(extract_gnss_from_nmea("track.nmea")[1])
    return [round((stamp - stamps[0]) / 1e9, 3) for stamp in stamps]

TIMES = [0, 0.25, 0.5, 0.75]
for digits, wanted in ((2, TIMES), (3, TIMES), (4, [0, 2.5, 5, 7.5]), (6, [0, 250, 500, 750])):
    seen = seconds("GP", digits, TIMES)
    print(f"{digits} digits: fixes at {seen} s")
    assert seen == wanted, seen
for name, seen in (("no point", seconds("GP", 0, [0, 1, 2])), ("GN", seconds("GN", 2, TIMES))):
    print(f"{name}: {len(seen)} fixes")
    assert seen == [], seen
PROGRAM
