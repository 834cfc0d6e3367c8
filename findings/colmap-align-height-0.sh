#!/usr/bin/env bash
# COLMAP 4.2 (pycolmap 4.2.1): locations whose heights are all 0, as local maps and receivers without
# heights give them, cannot be aligned to: align_reconstruction_to_locations and estimate_sim3d return
# None. The same locations one metre higher align to a centimetre. Points in a plane determine a
# similarity; only a plane (of locations or of centres) through the origin of coordinates is refused.
# Expected: one transform, shifted by the height. Seen: None at height 0, without a word of the cause,
# and the true scale of 3 within .1 % at 1 and 1000 m.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet pycolmap==4.2.1 numpy==2.4.6
"$work/venv/bin/python" - <<'PROGRAM'
import numpy as np
import pycolmap

rng = np.random.default_rng(0)
pycolmap.set_random_seed(0)
scene = pycolmap.SyntheticDatasetOptions()
scene.num_rigs, scene.num_frames_per_rig, scene.sensor_from_rig_translation_stddev = 1, 20, 0
model = pycolmap.synthesize_dataset(scene)

# A walk on level ground, in metres, and the same in a frame of the model's own, a third as large.
walk = np.cumsum(rng.normal(size=(20, 2)), axis=0)
metres = np.column_stack([walk, np.zeros(20)])
tilted = pycolmap.Rotation3d([0.1, 0.7, 0.1, 0.7])
for frame, place in zip(model.frames.values(), metres):
    centre = tilted * (place / 3) + [1, 2, 3] + rng.normal(scale=1e-3, size=3)
    frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(), -centre)
images = [model.images[next(iter(frame.image_ids)).id] for frame in model.frames.values()]
names, centres = [i.name for i in images], np.array([i.projection_center() for i in images])

options = pycolmap.RANSACOptions(max_error=0.1)
for height in (0, 1, 1000):
    locations = metres + [0, 0, height]
    fitted = pycolmap.estimate_sim3d(centres, locations)
    aligned = pycolmap.align_reconstruction_to_locations(model, names, locations, 3, options)
    print(f"height {height}: estimate_sim3d {fitted}, align_reconstruction_to_locations {aligned}")
    for found in (fitted, aligned):
        assert (found is None) == (height == 0), found
        if found is not None:
            errors = np.linalg.norm([found * c for c in centres] - locations, axis=1)
            assert abs(found.scale - 3) < 3e-3 and errors.max() < 0.02, (found, errors)
PROGRAM
