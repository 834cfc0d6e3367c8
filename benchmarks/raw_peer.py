"""The peer of `benchmarks/raw_fisheyes.py`: COLMAP on raw pairs with known lenses and rig.

    python benchmarks/raw_peer.py faces FRAMES CALIBRATION OUT [--start TRAJECTORY]

FRAMES holds `front/`, `back/` and timestamps.csv. Settings are those of `pycolmap.panorama` for its
rig of views: on the CPU, sequential matching with defaults, the incremental mapper with fixed rig
and intrinsics. Only the verification of matches is by pairs of images, COLMAP's default:
verification by the rig did not finish 60 frames of ten faces in 25 minutes of CPU time, and on 8
frames it still confused identical arches. With a trajectory, the mapper's triangulation and global
refinement also start from its poses.

Modes: `faces`, pinholes cut out of either lens up to its rim; `fisheyes`, the raw images, one
OPENCV_FISHEYE camera each; `fisheyes-88`, the raw images within 88 degrees from the axis. Writes
`alone.tum` and `trajectory.tum`, poses of the rig midway between the lenses, and costs.json of the
steps that they do not share.
"""

import argparse
import csv
import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

LENSES = ("front", "back")
FISHEYES = {"fisheyes": 99.0, "fisheyes-88": 88.0}  # mode -> largest angle from the axis, degrees
MODES = ("faces", *FISHEYES)
_BEYOND = np.tan(np.deg2rad(9.0))  # extent of side faces behind a lens: corners stay within it
_AHEAD = np.eye(3), np.diag([-1.0, 1.0, -1.0])  # rig_R_lens of upright lenses
_SIDES = {  # upright lens_R_face, and the extent of the face: left, top, right, bottom tangents
    "ahead": ([[1, 0, 0], [0, 1, 0], [0, 0, 1]], (1, 1, 1, 1)),
    "right": ([[0, 0, 1], [0, 1, 0], [-1, 0, 0]], (1, 1, _BEYOND, 1)),
    "left": ([[0, 0, -1], [0, 1, 0], [1, 0, 0]], (_BEYOND, 1, 1, 1)),
    "up": ([[1, 0, 0], [0, 0, -1], [0, 1, 0]], (1, _BEYOND, 1, 1)),
    "down": ([[1, 0, 0], [0, 0, 1], [0, -1, 0]], (1, 1, 1, _BEYOND)),
}


@dataclass(frozen=True, slots=True)
class View:
    """One camera of the peer's rig."""

    folder: str
    rig_T_view: np.ndarray  # (4, 4)
    model: str
    size: tuple[int, int]
    parameters: list[float]


def faces(frames: Path, pair, out: Path) -> list[View]:
    """Cut the pinholes of all frames, with pycolmap.panorama's density."""
    from gsba.camera.fisheye import project
    from gsba.frames.dual_fisheye import width_of
    from gsba.geometry import pose

    views, focal = [], width_of(pair) / 8
    for name, lens, ahead in zip(LENSES, pair, _AHEAD, strict=True):
        pictures = sorted((frames / name).iterdir())
        for side, (turn, reach) in _SIDES.items():
            left, top, right, bottom = (round(focal * tangent) for tangent in reach)
            size = left + right, top + bottom
            rig_R_view = ahead @ np.array(turn, dtype=np.float64)
            x, y = np.meshgrid(np.arange(size[0]) + 0.5 - left, np.arange(size[1]) + 0.5 - top)
            rays = np.stack([x, y, np.full_like(x, focal)], axis=-1) @ rig_R_view.T
            places = (project(lens, rays) - 0.5).astype(np.float32)
            view = View(
                f"{name}_{side}",
                pose(rig_R_view, np.asarray(lens.centre)),
                "PINHOLE",
                size,
                [focal, focal, left, top],
            )
            (out / "images" / view.folder).mkdir(parents=True)
            for path in pictures:
                nothing = np.zeros(0, np.float32)
                cut = cv2.remap(_read(path), places, nothing, cv2.INTER_LANCZOS4)
                cv2.imwrite(str(out / "images" / view.folder / f"{path.stem}.png"), cut)
            views.append(view)
    return views


def fisheyes(frames: Path, pair, half_fov_deg: float, out: Path) -> list[View]:
    """Link the raw images, with masks of pixels within an angle from the axis."""
    from gsba.camera.fisheye import rotation_of, unproject
    from gsba.geometry import pose

    views = []
    for name, lens in zip(LENSES, pair, strict=True):
        size, turn = (lens.width, lens.height), rotation_of(lens)
        x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
        ahead = unproject(lens, np.stack([x, y], axis=-1)) @ turn[:, 2]
        mask = np.where(ahead > np.cos(np.deg2rad(half_fov_deg)), 255, 0).astype(np.uint8)
        for folder in ("images", "masks"):
            (out / folder / name).mkdir(parents=True)
        for path in sorted((frames / name).iterdir()):
            (out / "images" / name / path.name).symlink_to(path.resolve())
            cv2.imwrite(str(out / "masks" / name / f"{path.name}.png"), mask)
        parameters = [lens.focal, lens.focal, *lens.principal, *lens.radial]
        views.append(
            View(name, pose(turn, np.asarray(lens.centre)), "OPENCV_FISHEYE", size, parameters)
        )
    return views


def match(views: list[View], out: Path) -> Path:
    """Peer's database with features and verified matches of the images in `out`."""
    import pycolmap

    pycolmap.set_random_seed(0)
    database, reader = out / "database.db", {"camera_model": views[0].model}
    if (out / "masks").exists():
        reader["mask_path"] = str(out / "masks")
    pycolmap.extract_features(
        database,
        out / "images",
        reader_options=pycolmap.ImageReaderOptions(**reader),
        camera_mode=pycolmap.CameraMode.PER_FOLDER,
        extraction_options=pycolmap.FeatureExtractionOptions(use_gpu=False),
    )
    with pycolmap.Database.open(database) as opened:
        pycolmap.apply_rig_config([_rig(views)], opened)
    matching = pycolmap.FeatureMatchingOptions(use_gpu=False, skip_image_pairs_in_same_frame=True)
    pairing = pycolmap.SequentialPairingOptions()
    pycolmap.match_sequential(database, pairing_options=pairing, matching_options=matching)
    return database


def mapped(database: Path, out: Path):
    """Largest model of the incremental mapper; None = it found none."""
    import pycolmap

    (out / "sparse").mkdir()
    models = pycolmap.incremental_mapping(database, out / "images", out / "sparse", _options())
    return max(models.values(), key=lambda model: model.num_reg_frames(), default=None)


def adjusted(database: Path, views: list[View], seconds: dict[str, float], start: Path):
    """Model that the peer triangulates and adjusts from the poses of a trajectory in metres."""
    import pycolmap

    from gsba.geometry import inverse
    from gsba.trajectory.association import poses_at
    from gsba.trajectory.files import read_trajectory

    trajectory, options = read_trajectory(start), _options()
    with pycolmap.Database.open(database) as opened:
        cache = pycolmap.DatabaseCache.create(opened, pycolmap.DatabaseCacheOptions())
    model, mapper = pycolmap.Reconstruction(), pycolmap.IncrementalMapper(cache)
    model.load(cache)
    mapper.begin_reconstruction(model)
    for frame in model.frames.values():
        names = {Path(model.image(data.id).name).stem for data in frame.data_ids}
        world_T_rig = poses_at(trajectory, np.array([seconds[names.pop()]]))[0]
        frame.rig_from_world = pycolmap.Rigid3d(inverse(world_T_rig @ views[0].rig_T_view)[:3])
        model.register_frame(frame.frame_id)
    for image in model.reg_image_ids():
        mapper.triangulate_image(options.triangulation, image)
    mapper.complete_and_merge_tracks(options.triangulation)
    held = pycolmap.BundleAdjustmentOptions(
        refine_focal_length=False,
        refine_principal_point=False,
        refine_extra_params=False,
        refine_sensor_from_rig=False,
    )
    mapper.iterative_global_refinement(
        options.ba_global_max_refinements,
        options.ba_global_max_refinement_change,
        options.mapper,
        held,
        options.triangulation,
        False,
    )
    return model


def times_of(frames: Path) -> dict[str, float]:
    """Seconds of frames by their names."""
    rows = csv.DictReader((frames / "timestamps.csv").read_text().splitlines())
    return {Path(row["name"]).stem: float(row["timestamp"]) for row in rows}


def write_poses(model, views: list[View], times: dict[str, float], path: Path) -> None:
    """Write T_world_rig of the frames that a model poses, at their times."""
    from gsba.geometry import inverse
    from gsba.trajectory.files import write_tum
    from gsba.types import Trajectory

    first, found = views[0], dict[float, np.ndarray]()
    for image in model.images.values():
        if image.has_pose and image.name.startswith(f"{first.folder}/"):
            world_T_view = np.eye(4)
            world_T_view[:3] = image.cam_from_world().inverse().matrix()
            found[times[Path(image.name).stem]] = world_T_view @ inverse(first.rig_T_view)
    order = sorted(found)
    write_tum(path, Trajectory(np.array(order), np.array([found[time] for time in order])))


def _options():
    """Options of the mapper, with fixed rig and intrinsics."""
    import pycolmap

    return pycolmap.IncrementalPipelineOptions(
        random_seed=0,
        ba_refine_sensor_from_rig=False,
        ba_refine_focal_length=False,
        ba_refine_principal_point=False,
        ba_refine_extra_params=False,
    )


def _rig(views: list[View]):
    """Rig of the peer, whose frame is that of the first view."""
    import pycolmap

    from gsba.geometry import inverse

    cameras = []
    for view in views:
        view_T_first = inverse(view.rig_T_view) @ views[0].rig_T_view
        camera = pycolmap.Camera(
            model=view.model, width=view.size[0], height=view.size[1], params=view.parameters
        )
        camera.has_prior_focal_length = True
        cameras.append(
            pycolmap.RigConfigCamera(
                ref_sensor=view is views[0],
                image_prefix=f"{view.folder}/",
                cam_from_rig=None if view is views[0] else pycolmap.Rigid3d(view_T_first[:3]),
                camera=camera,
            )
        )
    return pycolmap.RigConfig(cameras=cameras)


def _read(path: Path) -> np.ndarray:
    picture = cv2.imread(str(path))
    if picture is None:
        sys.exit(f"{path}: cannot be read")
    return picture


def main() -> None:
    """Cut or link the images, reconstruct, and write the poses."""
    from gsba.camera.calibration import read_calibration

    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("mode", choices=list(MODES))
    for name in ("frames", "calibration", "out"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--start", type=Path, help="trajectory of the rig, metres")
    arguments = parser.parse_args()
    if arguments.out.exists() and any(path.name != "log.txt" for path in arguments.out.iterdir()):
        sys.exit(f"{arguments.out}: is not empty")
    pair = read_calibration(arguments.calibration)
    arguments.out.mkdir(parents=True, exist_ok=True)
    if arguments.mode == "faces":
        views = faces(arguments.frames, pair, arguments.out)
    else:
        views = fisheyes(arguments.frames, pair, FISHEYES[arguments.mode], arguments.out)
    database, times = match(views, arguments.out), times_of(arguments.frames)
    ways: dict[str, Callable[[], Any]] = {}
    if arguments.start:
        ways["trajectory"] = lambda: adjusted(database, views, times, arguments.start)
    ways["alone"] = lambda: mapped(database, arguments.out)
    costs = {}
    for name, way in ways.items():
        wall, cpu = time.perf_counter(), time.process_time()
        model = way()
        if model is not None:
            write_poses(model, views, times, arguments.out / f"{name}.tum")
        costs[name] = {
            "wall_s": time.perf_counter() - wall,
            "cpu_s": time.process_time() - cpu,
        }
    (arguments.out / "costs.json").write_text(json.dumps(costs))


if __name__ == "__main__":
    main()
