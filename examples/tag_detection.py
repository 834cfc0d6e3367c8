"""Detection of AprilTags in panoramas by OpenCV on cube faces, for april_tags.py."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from gsba.camera.rig import RIG_R_FACE, CubeRig
from gsba.frames.cubemap import cut
from gsba.geometry import pose

RIG = CubeRig(768, np.deg2rad(100.0))  # overlapping faces: one of them shows the whole tag
UNIT = np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]) / 2  # corners, OpenCV's order


@dataclass(frozen=True)
class Sighting:
    """Detection of a tag in a frame."""

    frame: int  # number of the frame
    tag: int  # number of the tag in its family
    bearings_rig: np.ndarray  # (4, 3) unit, bearings of its corners
    rig_T_tag: np.ndarray  # (4, 4) pose, metres


def find_tags(panoramas: list[Path], size_m: float) -> Iterator[Sighting]:
    """Yield detections of tags in panoramas; each tag of a frame once."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(dictionary, parameters)
    for frame, path in enumerate(panoramas):
        seen = set[int]()
        for face, picture in enumerate(cut(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), RIG)):
            corners, ids, _ = detector.detectMarkers(picture)
            for pixels, tag in zip(corners, [] if ids is None else ids.ravel(), strict=True):
                if int(tag) in seen:
                    continue
                seen.add(int(tag))
                bearings = RIG.bearings(pixels[0] + 0.5, face)
                along = bearings @ RIG_R_FACE[face]
                flat = np.ascontiguousarray(along[:, :2] / along[:, 2:])
                square = cv2.SOLVEPNP_IPPE_SQUARE
                _, turn, move = cv2.solvePnP(size_m * UNIT, flat, np.eye(3), None, flags=square)
                rig_T_tag = RIG_R_FACE[face] @ np.hstack([cv2.Rodrigues(turn)[0], move])
                yield Sighting(frame, int(tag), bearings, pose(rig_T_tag[:, :3], rig_T_tag[:, 3]))
