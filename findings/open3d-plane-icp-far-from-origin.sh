#!/usr/bin/env bash
# Open3D 0.20.0, `registration_icp` by points to planes and `registration_generalized_icp` of clouds at UTM
# coordinates, which they keep as doubles: the step is a turn about the origin of the coordinates, 5200 km away,
# and its equations are too badly conditioned for that. Points to points, about the centroids, have no such limit.
# Expected of two scans of a corner, 0.2 m apart, with the exact normals: the transform at any place. Seen: to
# 1e-9 m within 1 km of the origin, as by points to points anywhere; at 100 km and at UTM coordinates a first
# step throws the cloud metres to hundreds of metres away, and the result is returned with a fitness of 0.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet open3d==0.20.0 numpy==2.4.6 scipy==1.17.1
"$work/venv/bin/python" - <<'PROGRAM'
import numpy as np
import open3d
from scipy.spatial.transform import Rotation

registration = open3d.pipelines.registration
criteria = registration.ICPConvergenceCriteria(max_iteration=100)
flat = np.random.default_rng(0).uniform(0, 10, (3, 2000, 2))
walls = np.concatenate([np.insert(flat[axis], axis, 0, axis=1) for axis in range(3)])
normals = np.repeat(np.eye(3), 2000, axis=0)
turn = Rotation.from_euler("zyx", [1, 0.5, 0.3], degrees=True).as_matrix()

def cloud(points, directions):
    made = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    made.normals = open3d.utility.Vector3dVector(directions)
    return made

def off_by(place, generalized, estimation):
    """Largest distance of a registered point from its true place, and the fitness that is returned."""
    target, source = cloud(walls + place, normals), cloud((walls - [0.1, 0.05, -0.03]) @ turn + place, normals @ turn)
    run = registration.registration_generalized_icp if generalized else registration.registration_icp
    result = run(source, target, 1.0, np.eye(4), estimation, criteria)
    moved = np.asarray(source.transform(result.transformation).points)
    return np.abs(moved - walls - place).max(), result.fitness

methods = {
    "points to points": (False, registration.TransformationEstimationPointToPoint()),
    "points to planes": (False, registration.TransformationEstimationPointToPlane()),
    "generalized": (True, registration.TransformationEstimationForGeneralizedICP()),
}
for place in ((0, 0, 0), (1e3, 1e3, 0), (1e5, 1e5, 0), (5e5, 5.2e6, 400)):
    for name, method in methods.items():
        off, fitness = off_by(np.array(place, float), *method)
        print(f"at {place}, {name}: off by {off:.1e} m, fitness {fitness:.0f}")
        failed = max(place) > 5e4 and name != "points to points"
        assert (off > 1 and fitness == 0) if failed else (off < 1e-6 and fitness == 1)
PROGRAM
