"""AprilTags of known size at unknown poses, which set the scale.

    python examples/april_tags.py FRAMES TRAJECTORY RUN 0.2

The family's variables are the poses of the tags. OpenCV detects tags (family 36h11) on cube faces.
"""

import hashlib
import sys
from pathlib import Path

import gtsam
import numpy as np
from tag_detection import UNIT, Sighting, find_tags

from factors import bearing_residuals
from gsba import Family, MapSnapshot, RunResult, X, refine

SIGMA_RAD = np.deg2rad(0.1)  # of a corner's bearing, per axis


class AprilTags(Family):
    """Bearings of the corners of tags with an edge of `size_m` metres."""

    name = "tags"
    fixes_gauge = True

    def __init__(self, sightings: list[Sighting], size_m: float) -> None:
        self.sightings, self.corners = sightings, size_m * UNIT
        known = [(s.frame, s.tag, s.bearings_rig.tolist()) for s in sightings]
        self.digest = hashlib.sha256(repr((known, size_m)).encode()).hexdigest()

    def variables(self, snapshot: MapSnapshot) -> gtsam.Values:
        """Initial poses of the tags, each by the nearest frame that sees it."""
        values = gtsam.Values()
        for s in sorted(self.sightings, key=lambda s: np.linalg.norm(s.rig_T_tag[:3, 3])):
            if not values.exists(gtsam.symbol("T", s.tag)):
                world_T_tag = snapshot.world_T_rigs[s.frame] @ s.rig_T_tag
                values.insert(gtsam.symbol("T", s.tag), gtsam.Pose3(world_T_tag))
        return values

    def graph(self, snapshot: MapSnapshot) -> gtsam.NonlinearFactorGraph:
        """Factors of eight residuals for each detection, under a robust loss."""
        graph, loss = gtsam.NonlinearFactorGraph(), gtsam.noiseModel.mEstimator.Cauchy.Create(3.0)
        noise = gtsam.noiseModel.Robust.Create(loss, gtsam.noiseModel.Isotropic.Sigma(8, SIGMA_RAD))
        for s in self.sightings:
            keys = [X(s.frame), gtsam.symbol("T", s.tag)]
            graph.add(gtsam.CustomFactor(noise, keys, self._error_of(keys, s.bearings_rig)))
        return graph

    def _error_of(self, keys: list[int], bearings_rig: np.ndarray):
        def error(factor, values, jacobians):
            rig, tag = (values.atPose3(key).matrix() for key in keys)
            points = self.corners @ tag[:3, :3].T + tag[:3, 3]
            found = bearing_residuals(np.repeat(rig[None], 4, axis=0), points, bearings_rig)
            if jacobians is not None:
                turn = np.cross(np.eye(3), self.corners[:, None]).swapaxes(1, 2)  # w x corner
                by_tag = np.concatenate([turn, np.repeat(np.eye(3)[None], 4, axis=0)], axis=2)
                jacobians[0] = found[1].reshape(8, 6)
                jacobians[1] = (found[2] @ tag[:3, :3] @ by_tag).reshape(8, 6)
            return found[0].ravel()

        return error

    def report(self, snapshot: MapSnapshot) -> dict[str, list]:
        """Positions of the tags, metres."""
        tags = sorted({s.tag for s in self.sightings})
        poses = [snapshot.variables.atPose3(gtsam.symbol("T", tag)) for tag in tags]
        return {str(tag): p.translation().tolist() for tag, p in zip(tags, poses, strict=True)}


def main(frames: Path, trajectory: Path, out: Path, size_m: float) -> RunResult:
    """Refine frames with the tags that are detected in them."""
    found = list(find_tags(sorted(frames.glob("*.jpg")), size_m))
    result = refine(frames, trajectory, out, families=[AprilTags(found, size_m)])
    print(result.report["families"]["tags"])
    return result


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:4]), float(sys.argv[4]))
