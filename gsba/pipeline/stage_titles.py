"""Titles of stages: their names in the run's folder are short, the log says what they do."""

import re
from collections.abc import Sequence
from functools import cache

# Name of a stage, and its title. In names, `#` stands for a number that counts from 1, and `+` for
# one that counts from 0; titles show both from 1.
_TITLES = {
    "odometry": "track the video",
    "fetch+": "choose more frames of the video, round {0}",
    "carrier": "find what turns with the camera",
    "carrier#": "find what turns with the camera, raw frames cut anew",
    "segmented": "segment frames into masks",
    "distractors1": "find distractors",
    "distractors": "find distractors beside those found",
    "masks": "write masks",
    "frames": "list frames",
    "expected_drift": "foretell how weak the map will be",
    "features": "extract features",
    "features_closer": "extract more features at weak frames",
    "keypoints": "gather keypoints",
    "keypoints_closer": "gather keypoints, more at weak frames",
    "neighbours": "match neighbours",
    "neighbours_on_time": "match neighbours, the clock corrected",
    "clock": "check the trajectory's clock",
    "turn": "prove a turn on the spot",
    "steps": "check the trajectory's steps",
    "blank_frames": "list frames that show nothing",
    "odd_frames": "match the frames beside unmatched ones",
    "likeness": "compare all stills",
    "order": "compare neighbours with other frames",
    "tour": "search stills along epipolar lines",
    "features_tour": "add the places found to features",
    "keypoints_tour": "gather keypoints, places found among them",
    "imu": "align the gyro to matches of neighbours",
    "imu_closed": "align the gyro to the map, its loops closed",
    "imu_camera": "align the gyro to the map under its camera",
    "imu_aligned#": "align the gyro to aligned patches, round {0}",
    "imu_aligned#_+": "align the gyro to aligned patches, round {0}, camera estimate {1}",
    "imu_final": "align the gyro to the final map",
    "gauge": "align the trajectory to the families' world",
    "gauge_closed": "align the map to the families' world",
    "chain": "adjust the chain of relative poses",
    "chain2": "adjust it without implausible steps",
    "adjacent": "match neighbours along epipolar lines",
    "adjacent2": "match neighbours along epipolar lines, maps joined",
    "adjacent_lenses": "match neighbours along epipolar lines, under two lenses",
    "adjacent_stitched": "match neighbours along epipolar lines, under a stitching radius",
    "adjacent_raw+": "match neighbours along epipolar lines, under calibration {0}",
    "adjacent_closer": "match neighbours along epipolar lines, more at weak frames",
    "near": "match known points, loops open",
    "wide_lenses": "match known points, under two lenses",
    "wide_stitched": "match known points, under a stitching radius",
    "wide_raw+": "match known points, under calibration {0}",
    "wide_closer": "match known points, more at weak frames",
    "everywhere#": "match known points, pass {0}",
    "dense": "adjust with matches of neighbours",
    "registered": "join maps",
    "across": "match frames of joined maps",
    "similarities": "estimate similarities between maps",
    "across_points": "match points of joined maps whose frames share few",
    "across2": "match frames of joined maps, the points that they share known",
    "joined": "adjust joined maps",
    "loops": "match loops",
    "places": "recognise places",
    "loops2": "match loops, places recognised",
    "closed": "adjust with loops closed",
    "axes": "choose lens axes",
    "lenses+": "estimate lens centres, round {0}",
    "lensed+": "adjust under two lenses, round {0}",
    "seam": "measure the band blended at the seam",
    "stitch_radius": "estimate the stitching radius",
    "stitched": "adjust under a stitching radius",
    "stitch_radius_tried": "judge the stitching radius on trial",
    "settled_readout": "estimate the readout",
    "settled": "adjust poses and camera",
    "settled_far_readout": "estimate the readout, stitched at infinity",
    "settled_far": "adjust poses and camera, stitched at infinity",
    "calibrated": "calibrate raw lenses",
    "recalibrated": "adjust poses and calibrated lenses",
    "recalibrated_readout": "estimate the readout, with calibrated lenses",
    "calibrated+_readout": "estimate the readout, with calibrated lenses, round {0}",
    "calibrated+": "adjust poses and calibrated lenses, matched anew, round {0}",
    "strength": "measure the strength of the map",
    "placed_closer": "triangulate, more at weak frames",
    "dense_closer": "adjust, more at weak frames",
    "refined#": "adjust with known points, pass {0}",
    "align#": "align patches, round {0}",
    "aligned#": "adjust aligned patches, round {0}",
    "aligned#_+": "adjust aligned patches, round {0}, camera estimate {1}",
    "aligned#_instant": "adjust aligned patches, rows read at one instant, round {0}",
    "readout_aligned#": "estimate the readout from patches, round {0}",
    "axes_aligned#": "test lens axes that turn, round {0}",
    "calibrated_aligned#": "calibrate raw lenses from patches, round {0}",
    "stitch_radius_aligned#": "estimate the stitching radius from patches, round {0}",
    "stitching#": "estimate errors of stitching, round {0}",
    "settled_aligned#": "test whether round {0} is needed",
    "photometric": "adjust with grey values of patches",
    "splat": "adjust with a splat",
    "camera": "compute covariances of poses and camera",
    "reconstruction": "compute covariances, carry the map to the trajectory's world",
    "lenses": "keep the lenses for exports",
    "map": "keep the map for runs that start from it",
    "recut+": "choose the calibration that raw frames are cut anew by, after pass {0}",
    "recut+_undone": "take back the frames cut anew after pass {0}",
}
WITHOUT_GPS = "@without_gps"  # suffix of stages of a map whose images contradict the GPS fixes
_PREFIXES = {"first-": "first solution: ", "again_": "once more: ", "export-": "export "}


# Stages whose results tell of the camera.
LENS_CENTRES = ("lenses+",)  # give a LensCentres
READOUTS = (
    "settled_readout",
    "settled_far_readout",
    "recalibrated_readout",
    "calibrated+_readout",
    "readout_aligned#",
)
RECONSTRUCTION = "reconstruction"  # gives the Reconstruction of the run


def is_one_of(name: str, patterns: Sequence[str]) -> bool:
    """True if a stage's name, without what says when or of which recording, fits a pattern."""
    for prefix in _PREFIXES:
        name = name.removeprefix(prefix)
    return any(_matched(pattern, name.partition("@")[0]) for pattern in patterns)


def _matched(pattern: str, name: str) -> re.Match[str] | None:
    return re.fullmatch(re.sub("[#+]", r"(\\d+?)", pattern), name)


@cache
def title_of(name: str) -> str:
    """What a stage of this name does, in words; its name where there are none."""
    for prefix, words in _PREFIXES.items():
        if name.startswith(prefix):
            return words + title_of(name.removeprefix(prefix))
    if name.endswith(WITHOUT_GPS):
        return f"{title_of(name.removesuffix(WITHOUT_GPS))}, without GPS"
    stage, _, recording = name.partition("@")
    if recording:
        return f"{title_of(stage)}, recording {recording}"
    for pattern, title in _TITLES.items():
        found = _matched(pattern, name)
        if found is not None:
            starts = [int(sign == "+") for sign in re.findall("[#+]", pattern)]
            numbers = [int(n) + start for n, start in zip(found.groups(), starts, strict=True)]
            return title.format(*numbers)
    return name
