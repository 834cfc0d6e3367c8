"""Relative poses of stills metres apart: hypotheses, ranked by patches found along their epipolar
lines.

Descriptors propose poses. Each keypoint of a frame is then searched in the other picture along its
epipolar line, at all distances, its patch warped by planes; no keypoint of the other frame is
needed. The pose is fitted to the places found, from coarse to fine.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from factors.threads import map_in_threads
from gsba.camera.rig import CubeRig
from gsba.camera.sphere import bearings_from_erp
from gsba.config import FeatureSettings
from gsba.features.detection import SiftExtractor, extract
from gsba.frames import cubemap
from gsba.frames.panorama import load_grey
from gsba.geometry import angles_between, inverse, pose, rotation_angle, unit
from gsba.matching.guided_search import mutual_nearest
from gsba.matching.verification import sampled_pose
from gsba.odometry.patch_search import search_patches
from gsba.types import FrameSet
from gsba.types.records import slices

WIDTH = 1280  # pixels across the panoramas that are searched
_FACES = CubeRig(448, np.deg2rad(95.0))  # on which keypoints are found
_FEATURES = FeatureSettings(max_per_face=1200)
_LINE_STEP_DEG = 0.35  # along epipolar lines, and between lines beside them
MIN_PARALLAX_RAD = np.deg2rad(3.0)  # of keypoints that count for a pose
CELLS_PER_SIDE = 6  # of 15 degrees; keypoints of one surface agree together
MAX_OFF_RAD = np.deg2rad(0.5)  # of a place found in a third frame from the predicted one
MAX_ALIKE_LOG = 0.25  # of lengths and scales, below which hypotheses are no rivals
_FLOOR_Y = 0.25  # y of bearings below which a floor is likely
_PAD = 160  # columns beyond the seam: 45 degrees, more than a patch is wide
_NUM_KEYS, _NUM_FEW = 1000, 300  # keypoints of a frame that are searched; that give a first rank
_NUM_ROUGH, _NUM_REFINED = 6, 4  # best hypotheses of a step that are searched finely; refined
_MIN_RANK_SHARE = 0.4  # of the best hypothesis' rank, below which others are not refined
_ROWS_AT_ONCE = 512  # of descriptors that are compared with all others of their frame
_MIN_VOTES = 3  # keys that propose a length or a ratio of lengths
_MIN_MATCHES = 8  # that a pose is estimated from
# Subsets of matches that propose poses: largest cosine with another keypoint of the same frame,
# True = above the floor only, largest error in degrees, number of poses, each without the inliers
# of those before.
_PROPOSALS = (
    (2.0, False, 0.5, 3),
    (0.95, False, 0.5, 3),
    (0.93, True, 0.5, 2),
    (0.9, False, 0.5, 2),
    (0.95, True, 0.5, 2),
    (0.95, True, 1.0, 2),
    (2.0, True, 0.5, 2),
)


@dataclass(frozen=True, slots=True)
class TourFrame:
    """A frame's pictures and the keypoints that are searched in others."""

    picture: np.ndarray  # (h, 2h + 2 _PAD) float32, going on beyond the seam
    half: np.ndarray  # (h / 2, h + 2 _PAD) float32
    rays: np.ndarray  # (K, 3) of all keypoints
    descriptors: np.ndarray  # (K, D) float32, of unit length
    alikeness: np.ndarray  # (K,) largest cosine with another keypoint of the frame, 3 degrees away
    keys: np.ndarray  # (N, 3) rays that are searched, those without a look-alike first
    sound: np.ndarray  # (N,) bool, neither with a look-alike nor below the horizon
    sigmas_rad: np.ndarray  # (N,) noise of the keys


@dataclass(frozen=True, slots=True)
class Step:
    """A hypothesis of the pose between two frames, and the keypoints that fit."""

    f1_T_f0: np.ndarray  # (4, 4), unit translation
    depths0: np.ndarray  # (N,) of the first frame's keys, in lengths of the step; NaN = no fit
    depths1: np.ndarray  # of the second frame's
    places1: np.ndarray  # (N, 3) rays of the first frame's keys in the second; NaN = no fit
    places0: np.ndarray  # of the second frame's keys in the first
    rank: float
    num: int  # keypoints that fit


def frame_of(grey: np.ndarray, masks: np.ndarray | None) -> TourFrame:
    """A frame by its panorama (h, 2h) uint8 and the masks (6, N, N) bool of its faces."""
    faces = np.repeat(cubemap.cut(grey, _FACES)[..., None], 3, axis=3)
    found = extract(faces, masks, _FACES, SiftExtractor(_FEATURES))
    rays, descriptors = found.bearings_rig, unit(found.descriptors.astype(float)).astype(np.float32)
    alike = np.full(len(rays), -1.0)
    for some in slices(len(rays), _ROWS_AT_ONCE):
        likes = descriptors[some] @ descriptors.T
        likes[rays[some] @ rays.T > np.cos(np.deg2rad(3.0))] = -1
        alike[some] = likes.max(axis=1, initial=-1)
    order = np.random.default_rng(0).permutation(len(rays))
    order = order[np.abs(rays[order, 1]) < 0.88]
    worse = 2.0 * (alike[order] >= 0.95)
    worse += (rays[order, 1] > _FLOOR_Y) & (alike[order] >= 0.9)
    chosen = order[np.argsort(worse, kind="stable")][:_NUM_KEYS]
    sound = (rays[chosen, 1] <= _FLOOR_Y) & (alike[chosen] < 0.95)
    picture = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 0.7)
    half = cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    picture, half = (np.pad(one, ((0, 0), (_PAD, _PAD)), "wrap") for one in (picture, half))
    keys = np.ascontiguousarray(rays[chosen])
    return TourFrame(picture, half, rays, descriptors, alike, keys, sound, found.sigmas_rad[chosen])


def read_stills(frames: FrameSet, num_threads: int = 1) -> list[TourFrame]:
    """All frames of a run, with the keypoints that are searched."""

    def read(f: int) -> TourFrame:
        grey, mask = load_grey(frames, f, WIDTH)
        return frame_of(grey, None if mask is None else cubemap.cut_mask(mask, _FACES))

    return list(map_in_threads(read, len(frames), num_threads))


def found_places(
    one: TourFrame,
    other: TourFrame,
    rows: np.ndarray,
    f1_T_f0: np.ndarray,
    beside_deg: float,
    coarse: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Rows of keys that are found in the other frame, and their rays (M, 3) there."""
    rays = np.ascontiguousarray(one.keys[rows])
    scores, pixels = np.empty(len(rays), np.float32), np.zeros((len(rays), 2))
    pictures = (one.half, other.half) if coarse else (one.picture, other.picture)
    scale = 2 if coarse else 1
    rotation = np.ascontiguousarray(f1_T_f0[:3, :3])
    direction = np.ascontiguousarray(f1_T_f0[:3, 3])
    step = np.deg2rad(_LINE_STEP_DEG) * scale
    beside = int(beside_deg / _LINE_STEP_DEG / scale + 0.5)
    sample = np.deg2rad(0.375) * scale  # between samples of a patch, at full resolution
    search_patches(*pictures, _PAD, rays, rotation, direction, beside, step, sample, scores, pixels)
    found = scores > 0
    height = len(pictures[1])
    return rows[found], bearings_from_erp(pixels[found], 2 * height, height)


def fits(
    rays0: np.ndarray, rays1: np.ndarray, f1_T_f0: np.ndarray, max_error_deg: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Matches (M,) bool that fit a pose, their parallax, radians, and depths in frame 0, lengths of
    the step."""
    turned, step = rays0 @ f1_T_f0[:3, :3].T, np.broadcast_to(f1_T_f0[:3, 3], rays1.shape)
    across = np.cross(turned, rays1)
    squared = np.maximum(np.sum(across**2, axis=1), 1e-12)
    depths0 = np.sum(np.cross(rays1, step) * across, axis=1) / squared
    depths1 = np.sum(np.cross(turned, step) * across, axis=1) / squared
    off = np.sum(unit(np.cross(turned, step)) * rays1, axis=1)
    good = (np.abs(off) < np.deg2rad(max_error_deg)) & (depths0 > 0.15) & (depths1 > 0.1)
    return good, angles_between(turned, rays1), depths0


def _ransac(
    rays0: np.ndarray, rays1: np.ndarray, max_error_deg: float, seed: int = 0
) -> tuple[np.ndarray, np.ndarray] | None:
    """f1_T_f0 (4, 4) of unit translation with the most inliers (M,) bool, or None."""
    if len(rays0) < _MIN_MATCHES:
        return None
    found = sampled_pose(rays0, rays1, max_error_deg, 0.1, (1000, 10000), seed)
    if found is None:
        return None
    f1_T_f0, inliers = found
    return pose(f1_T_f0[:3, :3], unit(f1_T_f0[:3, 3])), inliers


def adjusted_pose(
    rays0: np.ndarray, rays1: np.ndarray, f1_T_f0: np.ndarray, width_rad: float
) -> np.ndarray:
    """The pose by least squares of sines off epipolar planes, Cauchy's loss of a width."""
    rotation, direction = f1_T_f0[:3, :3], f1_T_f0[:3, 3]
    for _ in range(20):
        turned = rays0 @ rotation.T
        normals = np.cross(turned, direction)
        lengths = np.linalg.norm(normals, axis=1, keepdims=True) + 1e-9
        off = np.sum(normals / lengths * rays1, axis=1)
        basis = np.linalg.svd(direction[None])[2][1:]
        by_turn = np.cross(turned, np.cross(np.broadcast_to(direction, rays1.shape), rays1))
        jacobian = np.hstack([by_turn, np.cross(rays1, turned) @ basis.T]) / lengths
        weights = 1 / (1 + (off / width_rad) ** 2)
        normal = jacobian.T @ (weights[:, None] * jacobian) + 1e-9 * np.eye(5)
        move = -np.linalg.solve(normal, jacobian.T @ (weights * off))
        rotation = Rotation.from_rotvec(move[:3]).as_matrix() @ rotation
        direction = unit(direction + basis.T @ move[3:])
        if np.linalg.norm(move) < 1e-7:
            break
    return pose(rotation, direction)


def _rank(good: np.ndarray, sound: np.ndarray) -> float:
    """Geometric mean of the keypoints that fit a hypothesis, all and sound ones."""
    return float(np.sqrt((1 + np.count_nonzero(good)) * (1 + np.count_nonzero(good & sound))))


def _best_pose(
    rays0: np.ndarray,
    rays1: np.ndarray,
    sound: np.ndarray,
    f1_T_f0: np.ndarray,
    max_error_deg: float,
    width_deg: float,
) -> np.ndarray:
    """Of the pose so far and those by RANSAC, each adjusted, the one that most matches fit."""
    starts = [f1_T_f0]
    for rows in (sound, np.ones(len(sound), bool)):
        found = _ransac(rays0[rows], rays1[rows], max_error_deg)
        starts += [found[0]] if found else []

    def weight(one: np.ndarray) -> float:
        good = fits(rays0, rays1, one, max_error_deg)[0]
        return np.count_nonzero(good & sound) + 0.3 * np.count_nonzero(good & ~sound)

    return max((adjusted_pose(rays0, rays1, s, np.deg2rad(width_deg)) for s in starts), key=weight)


def pose_errors_deg(one: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """Angles of rotation and of direction between two poses, degrees."""
    turn = rotation_angle(one[:3, :3] @ other[:3, :3].T)
    return float(np.degrees(turn)), float(np.degrees(angles_between(one[:3, 3], other[:3, 3])))


def alike_poses(one: np.ndarray, other: np.ndarray) -> bool:
    """True if two poses (4, 4) are so near that they are no rivals: one is less accurate."""
    turn, direction = pose_errors_deg(one, other)
    return turn < 3.0 and direction < 8.0


def agreed_logs(
    logs: np.ndarray, cells: np.ndarray, width: float, most: int
) -> list[tuple[float, int]]:
    """At most so many logarithms (N,) on which keys of most cells (N,) agree within a width, each
    without the keys of those before, and the number of these cells."""
    near, left = np.abs(logs[:, None] - logs) < width, np.ones(len(logs), bool)
    found = list[tuple[float, int]]()
    while np.count_nonzero(left) >= _MIN_VOTES and len(found) < most:
        agreeing = max(
            (near[n] & left for n in np.flatnonzero(left)),
            key=lambda some: (len(np.unique(cells[some])), np.count_nonzero(some)),
        )
        if np.count_nonzero(agreeing) < _MIN_VOTES:
            break
        found.append((float(np.median(logs[agreeing])), len(np.unique(cells[agreeing]))))
        left &= np.abs(logs - found[-1][0]) > 2 * width
    return found


def _distinct(
    ranked: list[tuple[float, np.ndarray]], turn_deg: float, direction_deg: float
) -> list[np.ndarray]:
    """Poses by falling rank, without those within both angles of a better one."""
    kept: list[np.ndarray] = []
    for _, one in sorted(ranked, key=lambda pair: -pair[0]):
        errors = [pose_errors_deg(one, other) for other in kept]
        if all(turn > turn_deg or direction > direction_deg for turn, direction in errors):
            kept.append(one)
    return kept


def _proposals(one: TourFrame, other: TourFrame) -> list[np.ndarray]:
    """Poses f1_T_f0 by descriptors, those with most inliers first."""
    if not (len(one.rays) and len(other.rays)):
        return []
    rows0, rows1 = mutual_nearest(one.descriptors, other.descriptors)
    likes = np.sum(one.descriptors[rows0] * other.descriptors[rows1], axis=1)
    rows0, rows1 = rows0[likes > 0.75], rows1[likes > 0.75]
    rays0, rays1 = one.rays[rows0], other.rays[rows1]
    alike = np.maximum(one.alikeness[rows0], other.alikeness[rows1])
    level = (rays0[:, 1] < _FLOOR_Y) & (rays1[:, 1] < _FLOOR_Y)
    found = list[tuple[float, np.ndarray]]()
    for limit, above, max_error_deg, num in _PROPOSALS:
        chosen = np.flatnonzero((alike < limit) & (level | (not above)))
        for seed in range(num):
            best = _ransac(rays0[chosen], rays1[chosen], max_error_deg, seed)
            if best is None or np.count_nonzero(best[1]) < _MIN_MATCHES:
                break
            found.append((float(np.count_nonzero(best[1])), best[0]))
            chosen = chosen[~best[1]]
    return _distinct(found, 3.0, 10.0)


def _roughly_ranked(
    one: TourFrame,
    other: TourFrame,
    starts: list[np.ndarray],
    beside_deg: float,
    coarse: bool,
    max_error_deg: float,
) -> list[tuple[float, np.ndarray]]:
    """Ranks and poses of hypotheses after a search with few keypoints."""
    sound = np.flatnonzero(one.sound)[: _NUM_FEW // 2]
    rest = np.setdiff1d(np.arange(len(one.keys)), sound)
    rest = np.random.default_rng(0).permutation(rest)[: _NUM_FEW // 2]
    few, found = np.concatenate([sound, rest]), list[tuple[float, np.ndarray]]()
    for start in starts:
        rows, places = found_places(one, other, few, start, beside_deg, coarse)
        if len(rows) >= _MIN_MATCHES:
            rays, sound_rows = one.keys[rows], one.sound[rows]
            best = _best_pose(rays, places, sound_rows, start, max_error_deg, max_error_deg * 0.6)
            good, parallax, _ = fits(rays, places, best, 0.7 * max_error_deg)
            found.append((_rank(good & (parallax > MIN_PARALLAX_RAD), sound_rows), best))
    return found


def _refined(one: TourFrame, other: TourFrame, f1_T_f0: np.ndarray) -> Step | None:
    """A hypothesis refined by keypoints of both frames, at last by all."""
    for beside_deg, every in ((0.7, 3), (0.35, 1)):
        few0, few1 = np.arange(len(one.keys))[::every], np.arange(len(other.keys))[::every]
        rows0, places1 = found_places(one, other, few0, f1_T_f0, beside_deg)
        rows1, places0 = found_places(other, one, few1, inverse(f1_T_f0), beside_deg)
        rays0 = np.vstack([one.keys[rows0], places0])
        rays1 = np.vstack([places1, other.keys[rows1]])
        if len(rays0) < _MIN_MATCHES:
            return None
        sound = np.concatenate([one.sound[rows0], other.sound[rows1]])
        f1_T_f0 = _best_pose(rays0, rays1, sound, f1_T_f0, 0.3, 0.15)
    return step_of(one, other, f1_T_f0, (rows0, places1), (rows1, places0))


def step_of(
    one: TourFrame,
    other: TourFrame,
    f1_T_f0: np.ndarray,
    found1: tuple[np.ndarray, np.ndarray],
    found0: tuple[np.ndarray, np.ndarray],
) -> Step:
    """A hypothesis with those of the places found in either frame (`found_places`) that fit it."""
    depths, rays, fitting = [], [], []
    for frame, (rows, places), at in ((one, found1, f1_T_f0), (other, found0, inverse(f1_T_f0))):
        good, parallax, depth = fits(frame.keys[rows], places, at, 0.2)
        good &= parallax > MIN_PARALLAX_RAD
        depths.append(np.full(len(frame.keys), np.nan))
        depths[-1][rows[good]] = depth[good]
        rays.append(np.full((len(frame.keys), 3), np.nan))
        rays[-1][rows[good]] = places[good]
        fitting.append(np.isfinite(depths[-1]))
    every = np.concatenate(fitting)
    rank = _rank(every, np.concatenate([one.sound, other.sound]))
    num = int(np.count_nonzero(every))
    return Step(f1_T_f0, depths[0], depths[1], rays[0], rays[1], rank, num)


def step_at(one: TourFrame, other: TourFrame, f1_T_f0: np.ndarray) -> Step:
    """A step of a known pose (4, 4), with all places that a search finds there."""
    f1_T_f0 = pose(f1_T_f0[:3, :3], unit(f1_T_f0[:3, 3]))
    every = np.arange(len(one.keys)), np.arange(len(other.keys))
    found1 = found_places(one, other, every[0], f1_T_f0, 0.35)
    found0 = found_places(other, one, every[1], inverse(f1_T_f0), 0.35)
    return step_of(one, other, f1_T_f0, found1, found0)


def rough_poses(one: TourFrame, other: TourFrame) -> list[tuple[float, np.ndarray]]:
    """Ranks of all poses f1_T_f0 between two frames that descriptors propose, and these poses,
    roughly fitted to places."""
    return _roughly_ranked(one, other, _proposals(one, other), 2.8, True, 0.6)


def hypotheses(one: TourFrame, other: TourFrame) -> list[Step]:
    """Hypotheses of the pose between two frames, by falling rank."""
    rough = rough_poses(one, other)
    for beside_deg, max_error_deg in ((0.7, 0.4), (0.35, 0.3)):
        starts = _distinct(rough, 1.5, 6.0)[:_NUM_ROUGH]
        rough = _roughly_ranked(one, other, starts, beside_deg, False, max_error_deg)
    least = _MIN_RANK_SHARE * max((rank for rank, _ in rough), default=0.0)
    found, kept = list[Step](), list[np.ndarray]()
    for rank, start in sorted(rough, key=lambda some: -some[0])[:_NUM_REFINED]:
        if rank < least and len(kept) > 2:
            break  # two rivals are known, and others are far behind
        step = _refined(one, other, start)
        found += [] if step is None else [step]
        kept = _distinct([(step.rank, step.f1_T_f0) for step in found], 0.7, 3.0)
    return [next(step for step in found if step.f1_T_f0 is one) for one in kept]
