"""Frames and photos localised in a finished run: errors against the truth, and CPU seconds.

    python -m benchmarks.localize [--work DIR] [--markdown benchmarks/results/localize.md]
    python -m benchmarks.localize --large RUN WALK [--lanes 8] [--work DIR]
    python -m benchmarks.localize --repeated WALK... [--work DIR]

A walk through the demo's gallery is rendered, and every fourth frame is held out. The others are
refined; frames held out and photos rendered at new places are then localised in that run. Photos
are 40 to 120 degrees wide, portrait and landscape, with distortion and a principal point off the
middle; in the last row they are of three cameras whose tags give a rounded focal length. Lengths
are those of the gallery, whose rooms are four units wide. Errors are those of poses carried to the
truth by the similarity of the run's own frames. NEES is over six degrees of freedom: 1 =
covariances are right.

`--large`: WALK is of `benchmarks.streets`, RUN its refined poses. Frames rendered halfway between
some of its frames are localised, and carried to the truth by the frames around each.

`--repeated`: walks through halls whose bays repeat. The map is of the first third of a walk without
every fourth frame; these and the frames beyond that third are localised. Right: nearer to the truth
than a quarter of a step.
"""

import argparse
import csv
import json
import shutil
import time
from collections.abc import Iterable, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path

import cv2
import gtsam
import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from benchmarks import streets
from gsba import Localizer, refine
from gsba.camera.projections import PerspectiveProjection
from gsba.camera.sphere import erp_from_bearings
from gsba.demo import make_walk
from gsba.demo.gallery import build_gallery
from gsba.demo.render import render_erp
from gsba.demo.walk import write_frames
from gsba.geometry import rotation_angle
from gsba.localization import LocalizedFrame, LocalizedPhotos, localize_photos, read_photo
from gsba.similarity import Sim3, pose_similarity
from gsba.trajectory.files import read_trajectory
from gsba.types import Trajectory

NUM_FRAMES, WIDTH, HELD_OUT = 40, 1280, 4
PANORAMA_WIDTH = 4096  # that photos are cut from
FIELDS = (40, 50, 60, 68, 75, 90, 110, 120)  # degrees, of a photo's longer side
SIZES = ((960, 720), (720, 960))  # landscape, portrait
SHARED = ((60, (960, 720)), (75, (720, 960)), (100, (960, 720)))  # cameras that photos share
PHOTOS_OF_EACH = 4
REPEATED = ["walk", "frames", "right", "elsewhere", "refused", "CPU s each"]
BETWEEN, AROUND = 20, 10  # frames rendered between those of a large map; frames around each


@dataclass(frozen=True, slots=True)
class Shot:
    """A rendered photo."""

    path: Path
    world_T_camera: np.ndarray  # (4, 4), the gallery's world
    projection: PerspectiveProjection


@dataclass(frozen=True, slots=True)
class Errors:
    """Errors of localised pictures."""

    position: np.ndarray  # (N,) 1e-3 units
    rotation: np.ndarray  # (N,) degrees
    nees: np.ndarray  # (N,) over six degrees of freedom

    def cells(self) -> list[str]:
        worst = f"{self.position.max():.2f}", f"{self.rotation.max():.4f}"
        median = f"{np.median(self.position):.2f}", f"{np.median(self.rotation):.4f}"
        return [median[0], worst[0], median[1], worst[1], f"{np.mean(self.nees):.1f}"]


def main() -> None:
    """Render, refine, localise, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--work", type=Path, default=Path("bench-localize"))
    parser.add_argument("--markdown", type=Path)
    parser.add_argument("--large", type=Path, nargs=2, metavar=("RUN", "WALK"))
    parser.add_argument("--lanes", type=int, default=8, help="of WALK")
    parser.add_argument("--repeated", type=Path, nargs="+", metavar="WALK")
    options = parser.parse_args()
    if options.repeated is not None:
        rows = [row for walk in options.repeated for row in _repeated(walk, options.work)]
        print(_lines([REPEATED, ["---", "---", *["---:"] * 4], *rows]))
        return
    if options.large is not None:
        of_map, walk = options.large
        print(_table([_large_row(of_map, walk, options.work / "between", options.lanes)]))
        return
    held, truth = _walk(options.work)
    run = options.work / "run"
    if not (run / "trajectory.tum").is_file():
        refine(options.work / "map", options.work / "walk/slam.tum", run)
    rows = [_map_row(run, truth)]
    rows += [_panoramas_row(run, truth, held, precise) for precise in (False, True)]
    single = _photos(options.work / "photos", _single_cameras(), tagged=False)
    shared = _photos(options.work / "shared", _shared_cameras(), tagged=True)
    rows.append(_photos_row("photos, a camera each, no tags", run, truth, single))
    rows.append(_photos_row("photos of three cameras, with tags", run, truth, shared))
    table = _table(rows)
    print(table)
    if options.markdown is not None:
        text = (__doc__ or "").split("\n\n", 2)[2]
        options.markdown.write_text(f"# Localisation\n\n{text}\n{table}\n", encoding="utf-8")


def _large_row(run: Path, walk: Path, work: Path, lanes: int) -> list[str]:
    """Row of frames between those of a walk through lanes."""
    truth = read_trajectory(walk / "groundtruth.tum")
    poses, localizer = truth.world_T_rigs, Localizer(run)
    num = len(poses)
    before = np.linspace(AROUND, num - AROUND, BETWEEN).astype(int)
    halfway = []
    for f in before:
        one, after = gtsam.Pose3(poses[f]), gtsam.Pose3(poses[f + 1])
        halfway.append(one.retract(0.5 * one.localCoordinates(after)).matrix())
    (work / "images").mkdir(parents=True, exist_ok=True)
    between = Trajectory(np.arange(float(BETWEEN)), np.array(halfway))
    first = cv2.imread(str(next((walk / "images").glob("*.jpg"))))
    assert first is not None
    height, width = first.shape[0], first.shape[1]
    scene = streets.built(streets.crossings(num, lanes, 0), 0)
    pictures = (render_erp(scene, pose, width, height) for pose in halfway)
    write_frames(work, between, pictures, 1)
    images = sorted((work / "images").glob("*.jpg"))
    localizer.localize(images[0])  # kernels are compiled, keyframes read
    begin = time.process_time()
    found = [localizer.localize(image) for image in images]
    cpu = (time.process_time() - begin) / BETWEEN
    errors = []
    for one, f, true in zip(found, before, halfway, strict=True):
        if one.found:
            rows = slice(f - AROUND + 1, f + AROUND + 1)
            move = pose_similarity(localizer.map.result.world_T_rigs[rows], poses[rows])
            errors.append(_errors(move, [(one.world_T_rig, one.covariance, true)]))
    every = Errors(*(np.concatenate(column) for column in zip(*map(astuple, errors), strict=True)))
    title = f"between {num} frames of lanes, {width} px"
    return [title, f"{len(errors)} of {BETWEEN}", *every.cells(), "", f"{cpu:.2f}"]


def _repeated(walk: Path, work: Path) -> list[list[str]]:
    """Rows of the frames between those of a map of a part of a walk, and of those beyond it."""
    truth = read_trajectory(walk / "groundtruth.tum").world_T_rigs
    images = sorted(path for path in (walk / "images").iterdir() if path.suffix in (".jpg", ".png"))
    third = len(images) // 3
    kept = [f for f in range(third) if f % HELD_OUT or f == 0]
    folder, run = work / walk.name / "map", work / walk.name / "run"
    _copy(walk / "images", kept, folder)
    refine(folder, None, run)
    localizer = Localizer(run)
    poses = localizer.map.result.world_T_rigs
    stems = [path.stem for path in images]
    move = pose_similarity(poses, truth[[stems.index(name) for name in localizer.map.frames.names]])
    near = float(np.median(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1))) / 4
    held, rows = [f for f in range(third) if f not in kept], []
    localizer.localize(images[held[0]])  # kernels are compiled, keyframes read
    for what, frames in (("between", held), ("beyond", range(third, len(images)))):
        begin = time.process_time()
        found = [(localizer.localize(images[f]), truth[f]) for f in frames]
        cpu = (time.process_time() - begin) / len(found)
        placed = [(move.poses(one.world_T_rig[None])[0], true) for one, true in found if one.found]
        right = sum(np.linalg.norm((a - b)[:3, 3]) < near for a, b in placed)
        counts = right, len(placed) - right, len(found) - len(placed)
        rows.append([walk.name, f"{len(found)} {what}", *map(str, counts), f"{cpu:.2f}"])
    return rows


def _walk(work: Path) -> tuple[list[int], Trajectory]:
    """Numbers of the frames held out, and the true poses of all; the others are in `work/map`."""
    held = list(range(HELD_OUT - 1, NUM_FRAMES, HELD_OUT))
    if not (work / "walk/groundtruth.tum").is_file():
        make_walk(work / "walk", "rectangle", "forward", NUM_FRAMES, WIDTH)
    _copy(work / "walk/images", [f for f in range(NUM_FRAMES) if f not in held], work / "map")
    return held, read_trajectory(work / "walk/groundtruth.tum")


def _copy(images: Path, kept: Sequence[int], folder: Path) -> None:
    """Copy some of a folder's images, by their numbers in its table of times, and their times."""
    folder.mkdir(parents=True, exist_ok=True)
    with (images / "timestamps.csv").open() as file:
        header, *times = list(csv.reader(file))
    for f in kept:
        path = next(images.glob(f"{Path(times[f][0]).stem}.*"))
        shutil.copyfile(path, folder / path.name)
    with (folder / "timestamps.csv").open("w", newline="") as file:
        csv.writer(file).writerows([header, *(times[f] for f in kept)])


def _to_truth(localizer: Localizer, truth: Trajectory) -> Sim3:
    """Similarity from the run's world to the truth's, by the run's own frames."""
    frames = [int(name) for name in localizer.map.frames.names]
    return pose_similarity(localizer.map.result.world_T_rigs, truth.world_T_rigs[frames])


def _errors(move: Sim3, pairs: Iterable[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> Errors:
    """Errors of poses, covariances and true poses."""
    rows = []
    for pose, covariance, true in pairs:
        moved = move.poses(pose[None])[0]
        error = gtsam.Pose3(moved).localCoordinates(gtsam.Pose3(true))
        scales = np.repeat([1.0, move.scale], 3)
        nees = error @ np.linalg.solve(scales[:, None] * covariance * scales, error) / 6
        far = 1e3 * np.linalg.norm(moved[:3, 3] - true[:3, 3])
        rows.append((far, np.degrees(rotation_angle(moved[:3, :3].T @ true[:3, :3])), nees))
    return Errors(*np.array(rows).T)


def _map_row(run: Path, truth: Trajectory) -> list[str]:
    localizer = Localizer(run)
    result, names = localizer.map.result, localizer.map.frames.names
    true = truth.world_T_rigs[[int(name) for name in names]]
    rows = np.arange(1, len(names))  # the first pose is fixed: its covariance is the gauge's
    given = result.world_T_rigs[rows], result.pose_covariances[rows], true[rows]
    found = _errors(_to_truth(localizer, truth), zip(*given, strict=True))
    return ["frames of the run", f"{len(names)} of {len(names)}", *found.cells(), "", ""]


def _panoramas_row(run: Path, truth: Trajectory, held: list[int], precise: bool) -> list[str]:
    localizer = Localizer(run, precise=precise)
    images = run.parent / "walk/images"
    localizer.localize(images / f"{held[0]:06d}.jpg")  # kernels are compiled, keyframes read
    begin = time.process_time()
    found = [localizer.localize(images / f"{f:06d}.jpg") for f in held]
    cpu = (time.process_time() - begin) / len(held)
    placed = [(one, f) for one, f in zip(found, held, strict=True) if one.found]
    pairs = [(one.world_T_rig, one.covariance, truth.world_T_rigs[f]) for one, f in placed]
    what = "held-out frames, keypoints and patches" if precise else "held-out frames, keypoints"
    errors = _errors(_to_truth(localizer, truth), pairs)
    return [what, f"{len(placed)} of {len(held)}", *errors.cells(), "", f"{cpu:.2f}"]


def _photos_row(what: str, run: Path, truth: Trajectory, shots: list[Shot]) -> list[str]:
    localizer = Localizer(run)
    photos = [read_photo(shot.path) for shot in shots]
    begin = time.process_time()
    found: LocalizedPhotos = localize_photos(localizer, photos)
    cpu = (time.process_time() - begin) / len(shots)
    placed: list[tuple[LocalizedFrame, Shot]] = [
        pair for pair in zip(found.frames, shots, strict=True) if pair[0].found
    ]
    pairs = [(one.world_T_rig, one.covariance, shot.world_T_camera) for one, shot in placed]
    errors = _errors(_to_truth(localizer, truth), pairs)
    focals = []
    for one, shot in placed:
        assert one.camera is not None
        focal = found.cameras[one.camera].projection.focal
        focals.append(100 * abs(focal / shot.projection.focal - 1))
        print(f"{shot.path.stem}: focal {focals[-1]:.3f} %", flush=True)
    of_focal = f"{np.median(focals):.3f} / {max(focals):.3f}"
    return [what, f"{len(placed)} of {len(shots)}", *errors.cells(), of_focal, f"{cpu:.2f}"]


def _single_cameras() -> list[PerspectiveProjection]:
    rng = np.random.default_rng(5)
    return [_camera(field, size, rng) for field in FIELDS for size in SIZES]


def _shared_cameras() -> list[PerspectiveProjection]:
    rng = np.random.default_rng(6)
    cameras = [_camera(field, size, rng) for field, size in SHARED]
    return [camera for camera in cameras for _ in range(PHOTOS_OF_EACH)]


def _camera(field: float, size: tuple[int, int], rng: np.random.Generator) -> PerspectiveProjection:
    """A camera with some distortion, whose principal point is off the middle."""
    focal = max(size) / 2 / np.tan(np.deg2rad(field) / 2)
    x, y = np.array(size) / 2 + rng.normal(0, 0.004 * size[0], 2)
    corner = (np.hypot(*size) / 2 / focal) ** 2  # distortion of some percent in the corners
    radial = (
        rng.uniform(-0.05, 0.05) / max(corner, 1),
        rng.uniform(-0.02, 0.02) / max(corner, 1) ** 2,
    )
    return PerspectiveProjection(*size, float(focal), (float(x), float(y)), radial)


def _photos(folder: Path, cameras: list[PerspectiveProjection], tagged: bool) -> list[Shot]:
    """Photos rendered near the walk, in any direction; those that exist are kept."""
    folder.mkdir(parents=True, exist_ok=True)
    rng, scene = np.random.default_rng(7), build_gallery()
    walk = read_trajectory(folder.parent / "walk/groundtruth.tum").world_T_rigs
    shots = []
    for n, camera in enumerate(cameras):
        pose = walk[int(rng.integers(len(walk)))].copy()
        pose[:3, 3] += rng.normal(0, [0.25, 0.12, 0.25])
        angles = rng.uniform([-180, -15, -8], [180, 15, 8])
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("yxz", angles, degrees=True).as_matrix()
        path = folder / f"{n:02d}.jpg"
        if not path.is_file():
            _write_photo(path, scene, pose, camera, np.random.default_rng([8, n]))
            _tag(path, camera if tagged else None)
        shots.append(Shot(path, pose, camera))
    (folder / "truth.json").write_text(
        json.dumps({shot.path.stem: shot.world_T_camera.tolist() for shot in shots})
    )
    return shots


def _write_photo(
    path: Path, scene, pose: np.ndarray, camera: PerspectiveProjection, rng: np.random.Generator
) -> None:
    panorama = render_erp(scene, pose, PANORAMA_WIDTH, PANORAMA_WIDTH // 2)
    grid = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    bearings = camera.unproject(np.stack(grid, axis=-1))
    pixels = erp_from_bearings(bearings, PANORAMA_WIDTH, PANORAMA_WIDTH // 2) + 3.5
    padded = cv2.copyMakeBorder(panorama, 4, 4, 4, 4, cv2.BORDER_WRAP)
    u, v = (np.ascontiguousarray(part, np.float32) for part in np.moveaxis(pixels, -1, 0))
    image = cv2.remap(padded, u, v, cv2.INTER_CUBIC) + 2 * rng.standard_normal((*u.shape, 3))
    Image.fromarray(np.clip(image + 0.5, 0, 255).astype(np.uint8)).save(path, quality=95)


def _tag(path: Path, camera: PerspectiveProjection | None) -> None:
    """Tags as a phone writes them: the focal length on 35 mm film, in whole millimetres."""
    if camera is None:
        return
    tags = Image.Exif()
    tags[0x010F], tags[0x0110] = "Maker", f"{camera.width}x{camera.height}"
    diagonal = np.hypot(camera.width, camera.height)
    tags.get_ifd(0x8769)[0xA405] = round(camera.focal * np.hypot(36, 24) / diagonal)
    with Image.open(path) as picture:
        picture.save(path, quality="keep", exif=tags)


def _table(rows: list[list[str]]) -> str:
    header = ["", "localised", "position, 1e-3, median", "worst", "rotation, deg, median", "worst"]
    header += ["NEES", "focal length, %, median / worst", "CPU s each"]
    return _lines([header, ["---", *["---:"] * (len(header) - 1)], *rows])


def _lines(rows: list[list[str]]) -> str:
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


if __name__ == "__main__":
    main()
