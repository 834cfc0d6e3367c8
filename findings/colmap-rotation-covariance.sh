#!/usr/bin/env bash
# COLMAP 4.2 (pycolmap 4.2.1), the covariance of a pose that estimate_ba_covariance and
# refine_absolute_pose return ("tangent space covariance in the order [rotation, translation]"): its
# rotations are half angles, as Ceres steps quaternions, and its translations are those of the pose.
# get_covariance_for_inverse and get_cam2_cov_from_cam1 take angles in radians and steps in SE(3).
# Expected: sigmas equal to the spread of the poses of 4000 drawings of noise. Seen: half of it about
# each axis; by get_covariance_for_inverse, a sixth of it for one axis of the camera's centre.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet pycolmap==4.2.1 numpy==2.4.6
"$work/venv/bin/python" - <<'PROGRAM'
import numpy as np
import pycolmap

NOISE_PX, DRAWINGS = 0.01, 4000
pycolmap.logging.minloglevel = 1
pycolmap.set_random_seed(1)
scene = pycolmap.SyntheticDatasetOptions()
scene.num_rigs, scene.num_frames_per_rig, scene.num_points3D = 1, 6, 150
scene.camera_model_id, scene.camera_params = pycolmap.CameraModelId.PINHOLE, [800, 800, 512, 384]
scene.sensor_from_rig_translation_stddev = 0
model = pycolmap.synthesize_dataset(scene)
image = model.images[min(model.images)]
seen = [point for point in image.points2D if point.has_point3D()]
pixels = np.array([point.xy for point in seen])
places = np.array([model.points3D[point.point3D_id].xyz for point in seen])
pose = image.cam_from_world()

config = pycolmap.BundleAdjustmentConfig()  # poses alone: points and intrinsics are known
for image_id in model.images:
    config.add_image(image_id)
for camera_id in model.cameras:
    config.set_constant_cam_intrinsics(camera_id)
for point_id in model.points3D:
    config.add_constant_point(point_id)
options = pycolmap.BundleAdjustmentOptions(refine_points3D=False, refine_sensor_from_rig=False)
adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
wanted = pycolmap.BACovarianceOptions(params=pycolmap.BACovarianceOptionsParams.POSES)
adjusted = pycolmap.estimate_ba_covariance(wanted, model, adjuster)

def refined(pixels):
    options = pycolmap.AbsolutePoseRefinementOptions(gradient_tolerance=1e-9)
    every = np.ones(len(pixels), bool)
    return pycolmap.refine_absolute_pose(pose, pixels, places, every, image.camera, options, True)

def centre(pose):
    return pose.inverse().translation

noise = np.random.default_rng(0).normal(scale=NOISE_PX, size=(DRAWINGS, *pixels.shape))
drawn = [refined(pixels + one)["cam_from_world"] for one in noise]
quaternions = np.array([(one.rotation * pose.rotation.inverse()).quat for one in drawn])
turns = 2 * quaternions[:, :3] * np.sign(quaternions[:, 3:])  # radians: these angles are small
true_turn = np.sqrt((turns**2).mean(0))
true_place = np.sqrt(((np.array([centre(one) for one in drawn]) - centre(pose)) ** 2).mean(0))

x, y, z = centre(pose)
moved = np.hstack([[[0, z, -y], [-z, 0, x], [y, -x, 0]], np.eye(3)])  # the centre, of a step in SE(3)
for name, covariance in (
    ("estimate_ba_covariance", adjusted.get_cam_cov_from_world(image.image_id)),
    ("refine_absolute_pose", refined(pixels)["covariance"]),
):
    covariance = NOISE_PX**2 * covariance
    inverse = pycolmap.get_covariance_for_inverse(pose, covariance)
    turn = np.sqrt(np.diag(covariance))[:3] / true_turn
    place = np.sqrt(np.diag(moved @ inverse @ moved.T)) / true_place
    print(f"{name}: sigma over spread {turn.round(2)} of rotation, {place.round(2)} of the centre")
    assert np.allclose(turn, 0.5, atol=0.03), turn
    assert place.min() < 0.3, place
# The helper itself is right about angles and steps in SE(3).
angles = np.hstack([turns, [(one * pose.inverse()).translation for one in drawn]])
inverse = pycolmap.get_covariance_for_inverse(pose, np.cov(angles.T))
place = np.sqrt(np.diag(moved @ inverse @ moved.T)) / true_place
print(f"get_covariance_for_inverse of the spread of angles: {place.round(2)} of the centre")
assert np.allclose(place, 1, atol=0.03), place
PROGRAM
