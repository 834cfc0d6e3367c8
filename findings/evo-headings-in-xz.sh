#!/usr/bin/env bash
# evo 1.38.1, projection to the plane xz (`project`, `--project_to_plane xz`: for cameras that look along
# z, as KITTI's poses do). Of each rotation it keeps the angle about y of the Euler angles about x, y and
# z. The middle one of these ranges from -90 to 90 degrees: headings beyond fold back. For the planes xy
# and yz the angle is the last or the first one, which ranges over all directions.
# Expected of poses in the plane, turned about its normal: unchanged. Seen: headings of 60, 120 and 170
# degrees become 60, 60 and 10 in xz alone, and an estimate that looks 60 degrees past the truth has a
# rotation error (APE) of 60 degrees before the projection and of 0 after it.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet evo==1.38.1 numpy==2.4.6 scipy==1.17.1
export HOME=$work
"$work/venv/bin/python" - <<'PROGRAM'
import numpy as np
from evo.core.metrics import APE, PoseRelation, StatisticsType
from evo.core.trajectory import Plane, PosePath3D
from scipy.spatial.transform import Rotation

AXES = dict(zip("xyz", np.eye(3)))

def walk(axis, headings):
    """Poses at one place, turned about an axis by angles in degrees."""
    poses = np.tile(np.eye(4), (len(headings), 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(np.outer(np.radians(headings), AXES[axis])).as_matrix()
    return PosePath3D(poses_se3=list(poses))

def headings(path, axis):
    turns = Rotation.from_matrix([pose[:3, :3] for pose in path.poses_se3])
    return np.degrees(turns.as_rotvec() @ AXES[axis])

wanted = np.array([60.0, 120.0, 170.0])
for plane, axis in ((Plane.XY, "z"), (Plane.YZ, "x"), (Plane.XZ, "y")):
    path = walk(axis, wanted)
    path.project(plane)
    print(f"{plane.value}: headings {wanted} become {headings(path, axis).round(6)}")
    folded = np.minimum(wanted, 180 - wanted) if plane is Plane.XZ else wanted
    assert np.allclose(headings(path, axis), folded), headings(path, axis)

truth, estimate = walk("y", [60.0] * 3), walk("y", [120.0] * 3)
for name, wanted in (("before", 60), ("after", 0)):
    error = APE(PoseRelation.rotation_angle_deg)
    error.process_data((truth, estimate))
    seen = error.get_statistic(StatisticsType.rmse)
    print(f"rotation error of an estimate 60 degrees off, {name} the projection: {seen:.3f} degrees")
    assert np.isclose(seen, wanted, atol=1e-5), seen
    if name == "before":
        truth.project(Plane.XZ)
        estimate.project(Plane.XZ)
PROGRAM
