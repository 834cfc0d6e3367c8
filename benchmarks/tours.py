"""Relative poses of stills metres apart: patches searched along epipolar lines of hypotheses.

    python benchmarks/tours.py OUT.md TOUR [TOUR ...]

TOUR: a folder with images/*.jpg, groundtruth.tum and, if a carrier is in the pictures, mask.png, as
`render_home.py OUT -n 20` writes it. Frames next to one another are compared:

1. Hypotheses: RANSAC on mutual nearest neighbours of SIFT, each without the inliers of those
   before, on several subsets of keypoints (without those that have a look-alike in their own frame,
   without those below the horizon, where a floor repeats).
2. Each keypoint of a frame is searched in the other picture along its epipolar line, at all
   distances and a little beside the line, its patch warped by planes. The best place, unless
   another one is about as good, is moved by Lucas and Kanade's method. A pose is fitted to these
   matches, and so on from coarse to fine. No keypoint of the other frame is asked for.
3. Hypotheses are ranked by the keypoints that fit: the geometric mean of all and of those
   without look-alikes and floor. Few keypoints and a coarse picture choose those that are searched
   finely, and what then comes near the best one is refined with all keypoints.
4. The best chain over all frames is chosen by these ranks and by keypoints whose distances agree in
   both neighbouring steps, which also give the ratio of the steps' lengths.
   Of ratios, the one that most cells of 15 degrees agree on counts: a floor's pattern fills few.
5. Where a step or a ratio is in doubt, the chain ends. Each cell has one vote: for
   the hypothesis, or the ratio, that more of its keypoints fit. A sign test over cells tells how
   easily a rival as good would have come off so badly. Steps are in doubt, too, where keypoints
   that do not fit prefer one rival to all that rank below it: a place that repeats.
6. Each map is adjusted with the places that the search found.

A prototype, not part of the product: results/tours.md says what it finds and what is open.
"""

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import gtsam
import numpy as np
import pycolmap
from common import write_table
from patch_search import search_patches
from scipy.spatial.transform import Rotation
from scipy.stats import binom

import gsba
from factors import BearingTerm, LandmarkBlock, RobustLoss
from gsba.camera.rig import CubeRig, cells_of
from gsba.camera.sphere import bearings_from_erp
from gsba.config import FeatureSettings
from gsba.evaluate.trajectory import pose_errors
from gsba.features.detection import SiftExtractor, extract
from gsba.frames import cubemap
from gsba.geometry import angles_between, inverse, pose, rotation_angle, unit
from gsba.trajectory.files import read_trajectory
from gsba.trajectory.steps import chained
from gsba.types import Trajectory

SAMPLE_RAD = np.deg2rad(0.375)  # between samples of a patch, at full resolution
LINE_STEP_DEG = 0.35  # along epipolar lines, and between lines beside them
MIN_PARALLAX = np.deg2rad(3.0)  # of keypoints that tell a direction
FLOOR_Y = 0.25  # y of bearings below which a floor is likely
NUM_KEYS, NUM_FEW = 1000, 300  # keypoints of a frame that are searched; for a first rank
NUM_ROUGH, NUM_REFINED = 6, 4  # hypotheses of a step, the best by a coarse search; refined
MIN_SHARE = 0.4  # of the best hypothesis' rank, below which others are not refined
SIGMA_RAD = 2e-3  # of the places that the search finds
LENGTH_SIGMA = 0.8  # of the logarithm of the ratio of two steps' lengths
MAX_DOUBT, MAX_DOUBT_OF_RATIO = 1e-3, 1e-2  # of a step; of the ratio of two steps' lengths
RATIO_WIDTH = 0.08  # of its logarithm, in which keypoints agree on a ratio


@dataclass(frozen=True, slots=True)
class View:
    """A frame's pictures and the keypoints that are searched in others."""

    picture: np.ndarray  # (h, 2h) float32
    half: np.ndarray  # the same at half the resolution
    rays: np.ndarray  # (K, 3) of all keypoints
    descriptors: np.ndarray  # (K, D) of unit length
    alikeness: np.ndarray  # (K,) largest cosine with another keypoint of the frame, 3 degrees away
    keys: np.ndarray  # (N, 3) rays that are searched, those that are alone first
    sound: np.ndarray  # (N,) bool, neither with a look-alike nor below the horizon


@dataclass(frozen=True, slots=True)
class Step:
    """A hypothesis of the pose between two frames, and the keypoints that fit."""

    f1_T_f0: np.ndarray  # (4, 4), unit translation
    depths0: np.ndarray  # (N,) of the first frame's keys, in lengths of the step; nan = no fit
    depths1: np.ndarray  # of the second frame's
    places1: np.ndarray  # (N, 3) rays of the first frame's keys in the second; nan = no fit
    places0: np.ndarray  # of the second frame's keys in the first
    rank: float
    num: int


def load(tour: Path) -> tuple[list[View], Trajectory]:
    """The frames of a tour in order, and their true poses."""
    mask = cv2.imread(str(tour / "mask.png"), cv2.IMREAD_GRAYSCALE)
    rig = CubeRig(448, np.deg2rad(95.0))
    masks = None if mask is None else cubemap.cut_mask(mask > 127, rig)
    extractor, views = SiftExtractor(FeatureSettings(max_per_face=1200)), []
    for path in sorted((tour / "images").glob("*.jpg")):
        colours = np.ascontiguousarray(np.asarray(cv2.imread(str(path)))[..., ::-1])
        found = extract(cubemap.cut(colours, rig), masks, rig, extractor)
        rays, descriptors = found.bearings_rig.astype(float), unit(found.descriptors.astype(float))
        likes = descriptors @ descriptors.T
        likes[rays @ rays.T > np.cos(np.deg2rad(3.0))] = -1
        alike = likes.max(axis=1)
        order = np.random.default_rng(0).permutation(len(rays))
        order = order[np.abs(rays[order, 1]) < 0.88]
        worse = 2.0 * (alike[order] >= 0.95)
        worse += (rays[order, 1] > FLOOR_Y) & (alike[order] >= 0.9)
        chosen = order[np.argsort(worse, kind="stable")][:NUM_KEYS]
        sound = (rays[chosen, 1] <= FLOOR_Y) & (alike[chosen] < 0.95)
        grey = cv2.cvtColor(colours, cv2.COLOR_RGB2GRAY).astype(np.float32)
        grey = cv2.GaussianBlur(grey, (0, 0), 0.7)
        half = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        keys = np.ascontiguousarray(rays[chosen])
        views.append(View(grey, half, rays, descriptors, alike, keys, sound))
    return views, read_trajectory(tour / "groundtruth.tum")


def search(
    one: View, other: View, rows: np.ndarray, f1_T_f0: np.ndarray, beside_deg: float, coarse: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Rows of keys that are found in the other frame, and their rays (M, 3) there."""
    rays = np.ascontiguousarray(one.keys[rows])
    scores, pixels = np.empty(len(rays), np.float32), np.zeros((len(rays), 2))
    pictures = (one.half, other.half) if coarse else (one.picture, other.picture)
    scale = 2 if coarse else 1
    rotation = np.ascontiguousarray(f1_T_f0[:3, :3])
    direction = np.ascontiguousarray(f1_T_f0[:3, 3])
    step = np.deg2rad(LINE_STEP_DEG) * scale
    beside = int(beside_deg / LINE_STEP_DEG / scale + 0.5)
    sample = SAMPLE_RAD * scale
    search_patches(*pictures, rays, rotation, direction, beside, step, sample, scores, pixels)
    found = scores > 0
    height, width = pictures[1].shape
    return rows[found], bearings_from_erp(pixels[found], width, height)


def triangulated(
    rays0: np.ndarray, rays1: np.ndarray, f1_T_f0: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depths (M,) in either frame, lengths of the step, and sines off the epipolar planes."""
    turned, step = rays0 @ f1_T_f0[:3, :3].T, np.broadcast_to(f1_T_f0[:3, 3], rays1.shape)
    across = np.cross(turned, rays1)
    squared = np.maximum(np.sum(across**2, axis=1), 1e-12)
    depths0 = np.sum(np.cross(rays1, step) * across, axis=1) / squared
    depths1 = np.sum(np.cross(turned, step) * across, axis=1) / squared
    return depths0, depths1, np.sum(unit(np.cross(turned, step)) * rays1, axis=1)


def fits(
    rays0: np.ndarray, rays1: np.ndarray, f1_T_f0: np.ndarray, most_deg: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Matches (M,) bool that fit a pose, their parallax, radians, and depths in frame 0."""
    depths0, depths1, off = triangulated(rays0, rays1, f1_T_f0)
    good = (np.abs(off) < np.deg2rad(most_deg)) & (depths0 > 0.15) & (depths1 > 0.1)
    return good, angles_between(rays0 @ f1_T_f0[:3, :3].T, rays1), depths0


def ransac(rays0: np.ndarray, rays1: np.ndarray, most_deg: float, seed: int = 0):
    """f1_T_f0 (4, 4) of unit translation with the most inliers (M,) bool, or None."""
    if len(rays0) < 8:
        return None
    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed = np.deg2rad(most_deg), seed
    options.min_num_trials, options.max_num_trials = 1000, 10000
    options.min_inlier_ratio = 0.1
    found = pycolmap.estimate_relative_pose(rays0, rays1, options)
    if found is None:
        return None
    matrix = found["cam2_from_cam1"].matrix()
    inliers = np.asarray(found["inlier_mask"], bool)
    return pose(matrix[:, :3], unit(matrix[:, 3])), inliers


def adjusted_pose(
    rays0: np.ndarray, rays1: np.ndarray, f1_T_f0: np.ndarray, width: float
) -> np.ndarray:
    """The pose by least squares of sines off epipolar planes, Cauchy's loss of `width`."""
    rotation, direction = f1_T_f0[:3, :3], f1_T_f0[:3, 3]
    for _ in range(20):
        turned = rays0 @ rotation.T
        normals = np.cross(turned, direction)
        lengths = np.linalg.norm(normals, axis=1, keepdims=True) + 1e-9
        off = np.sum(normals / lengths * rays1, axis=1)
        basis = np.linalg.svd(direction[None])[2][1:]
        by_turn = np.cross(turned, np.cross(np.broadcast_to(direction, rays1.shape), rays1))
        jacobian = np.hstack([by_turn, np.cross(rays1, turned) @ basis.T]) / lengths
        weights = 1 / (1 + (off / width) ** 2)
        normal = jacobian.T @ (weights[:, None] * jacobian) + 1e-9 * np.eye(5)
        move = -np.linalg.solve(normal, jacobian.T @ (weights * off))
        rotation = Rotation.from_rotvec(move[:3]).as_matrix() @ rotation
        direction = unit(direction + basis.T @ move[3:])
        if np.linalg.norm(move) < 1e-7:
            break
    return pose(rotation, direction)


def rank_of(num: int, num_sound: int) -> float:
    """Geometric mean of the keypoints that fit a hypothesis, all and sound ones."""
    return float(np.sqrt((1 + num_sound) * (1 + num)))


def better(
    rays0: np.ndarray,
    rays1: np.ndarray,
    sound: np.ndarray,
    f1_T_f0: np.ndarray,
    most_deg: float,
    width_deg: float,
) -> np.ndarray:
    """Of the pose so far and those by RANSAC, each adjusted, the one that most matches fit."""
    starts = [f1_T_f0]
    for rows in (sound, np.ones(len(sound), bool)):
        found = ransac(rays0[rows], rays1[rows], most_deg)
        starts += [found[0]] if found else []

    def rank(one: np.ndarray) -> float:
        good = fits(rays0, rays1, one, most_deg)[0]
        return np.count_nonzero(good & sound) + 0.3 * np.count_nonzero(good & ~sound)

    return max((adjusted_pose(rays0, rays1, s, np.deg2rad(width_deg)) for s in starts), key=rank)


def differ(one: np.ndarray, other: np.ndarray, turn_deg: float, direction_deg: float) -> bool:
    """True if two poses differ by more than one of these angles."""
    turn, direction = errors(one, other)
    return turn > turn_deg or direction > direction_deg


def errors(one: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """Angles of rotation and of direction between two poses, degrees."""
    turn = rotation_angle(one[:3, :3] @ other[:3, :3].T)
    direction = angles_between(one[:3, 3], other[:3, 3])
    return float(np.degrees(turn)), float(np.degrees(direction))


def hypotheses(one: View, other: View) -> list[np.ndarray]:
    """Poses f1_T_f0 by descriptors, the best supported first."""
    likes = one.descriptors @ other.descriptors.T
    nearest = likes.argmax(axis=1)
    rows = np.flatnonzero(likes.argmax(axis=0)[nearest] == np.arange(len(nearest)))
    rows = rows[likes[rows, nearest[rows]] > 0.75]
    rays0, rays1 = one.rays[rows], other.rays[nearest[rows]]
    alike = np.maximum(one.alikeness[rows], other.alikeness[nearest[rows]])
    level = (rays0[:, 1] < FLOOR_Y) & (rays1[:, 1] < FLOOR_Y)
    found = []
    for limit, above, most_deg, num in (
        (2.0, False, 0.5, 3),
        (0.95, False, 0.5, 3),
        (0.93, True, 0.5, 2),
        (0.9, False, 0.5, 2),
        (0.95, True, 0.5, 2),
        (0.95, True, 1.0, 2),
        (2.0, True, 0.5, 2),
    ):
        chosen = np.flatnonzero((alike < limit) & (level | (not above)))
        for seed in range(num):
            best = ransac(rays0[chosen], rays1[chosen], most_deg, seed)
            if best is None or np.count_nonzero(best[1]) < 8:
                break
            found.append((np.count_nonzero(best[1]), best[0]))
            chosen = chosen[~best[1]]
    return distinct(found, 3.0, 10.0)


def distinct(
    ranked: list[tuple[float, np.ndarray]], turn_deg: float, direction_deg: float
) -> list[np.ndarray]:
    """Poses by falling rank, without those that are near a better one."""
    kept: list[np.ndarray] = []
    for _, one in sorted(ranked, key=lambda pair: -pair[0]):
        if all(differ(one, other, turn_deg, direction_deg) for other in kept):
            kept.append(one)
    return kept


def rough_ranks(
    one: View, other: View, starts: list[np.ndarray], beside: float, coarse: bool, most_deg: float
) -> list[tuple[float, np.ndarray]]:
    """Hypotheses after a search with few keypoints, and their ranks."""
    sound = np.flatnonzero(one.sound)[: NUM_FEW // 2]
    rest = np.setdiff1d(np.arange(len(one.keys)), sound)
    rest = np.random.default_rng(0).permutation(rest)[: NUM_FEW // 2]
    few, found = np.concatenate([sound, rest]), []
    for start in starts:
        rows, places = search(one, other, few, start, beside, coarse)
        if len(rows) >= 8:
            rays, width = one.keys[rows], most_deg * 0.6
            f1_T_f0 = better(rays, places, one.sound[rows], start, most_deg, width)
            good, parallax, _ = fits(rays, places, f1_T_f0, 0.7 * most_deg)
            good &= parallax > MIN_PARALLAX
            num, num_sound = np.count_nonzero(good), np.count_nonzero(good & one.sound[rows])
            found.append((rank_of(int(num), int(num_sound)), f1_T_f0))
    return found


def refined(one: View, other: View, f1_T_f0: np.ndarray) -> Step | None:
    """A hypothesis refined by keypoints of both frames, at last by all."""
    for beside, every in ((0.7, 3), (0.35, 1)):
        few0, few1 = np.arange(len(one.keys))[::every], np.arange(len(other.keys))[::every]
        rows0, places1 = search(one, other, few0, f1_T_f0, beside, False)
        rows1, places0 = search(other, one, few1, inverse(f1_T_f0), beside, False)
        rays0 = np.vstack([one.keys[rows0], places0])
        rays1 = np.vstack([places1, other.keys[rows1]])
        if len(rays0) < 8:
            return None
        sound = np.concatenate([one.sound[rows0], other.sound[rows1]])
        f1_T_f0 = better(rays0, rays1, sound, f1_T_f0, 0.3, 0.15)
    depths, rays, num, num_sound = [], [], 0, 0
    for view, rows, places, at in (
        (one, rows0, places1, f1_T_f0),
        (other, rows1, places0, inverse(f1_T_f0)),
    ):
        good, parallax, depth = fits(view.keys[rows], places, at, 0.2)
        good &= parallax > MIN_PARALLAX
        depths.append(np.full(len(view.keys), np.nan))
        depths[-1][rows[good]] = depth[good]
        rays.append(np.full((len(view.keys), 3), np.nan))
        rays[-1][rows[good]] = places[good]
        num += int(np.count_nonzero(good))
        num_sound += int(np.count_nonzero(good & view.sound[rows]))
    rank = rank_of(num, num_sound)
    return Step(f1_T_f0, depths[0], depths[1], rays[0], rays[1], rank, num)


def steps_between(one: View, other: View) -> list[Step]:
    """Hypotheses of the pose between two frames, by falling rank."""
    rough = rough_ranks(one, other, hypotheses(one, other), 2.8, True, 0.6)
    for beside, most in ((0.7, 0.4), (0.35, 0.3)):
        rough = rough_ranks(one, other, distinct(rough, 1.5, 6.0)[:NUM_ROUGH], beside, False, most)
    least = MIN_SHARE * max((rank for rank, _ in rough), default=0.0)
    by_rank, found, kept = sorted(rough, key=lambda some: -some[0]), [], []
    for rank, start in by_rank[:NUM_REFINED]:
        if rank < least and len(kept) > 2:
            break  # two rivals are known, and others are far behind
        step = refined(one, other, start)
        found += [] if step is None else [step]
        kept = distinct([(step.rank, step.f1_T_f0) for step in found], 0.7, 3.0)
    return [next(step for step in found if step.f1_T_f0 is one) for one in kept]


def doubt(for_one: np.ndarray, for_other: np.ndarray, cells: np.ndarray) -> float:
    """Chance that so many cells of the sphere have more keypoints for one of two rivals, were
    either as likely in each cell, independently. Keypoints: (N,) bool, bool and cell."""
    balance = np.bincount(cells, for_one.astype(float) - for_other.astype(float))
    num = np.count_nonzero(balance > 0)
    return float(binom.sf(num - 1, num + np.count_nonzero(balance < 0), 0.5))


def doubts_of_step(step: Step, found: list[Step], one: View, other: View) -> tuple[float, float]:
    """`doubt` of a hypothesis against the best of its rivals, and of the best rival, by keypoints
    that do not fit the hypothesis, against those that rank below it: small where a place repeats.
    """
    cells = np.r_[cells_of(one.keys, 6), cells_of(other.keys, 6)]
    cells[len(one.keys) :] += cells.max() + 1

    def fitting(some: Step) -> np.ndarray:
        return np.isfinite(np.r_[some.depths0, some.depths1])

    mine = fitting(step)
    rivals = [fitting(rival) for rival in found if rival is not step]
    behind = max(doubt(mine, theirs, cells) for theirs in [np.zeros_like(mine), *rivals])
    left = [theirs & ~mine for theirs in rivals]
    repeated = [
        max(doubt(theirs, later, cells) for later in left[k + 1 :])
        for k, theirs in enumerate(left[:-1])
    ]
    return behind, min(repeated, default=1.0)


def doubt_of_ratio(before: Step, after: Step, view: View) -> float:
    """`doubt` of the ratio of two steps' lengths against the best other ratio, times the number of
    ratios that were tried; by all keypoints or by sound ones, times two."""
    both = np.isfinite(before.depths1) & np.isfinite(after.depths0)
    ratio, doubts = votes(before, after, view.keys)[2], [0.5]
    for rows in (both, both & view.sound):
        if not rows.any():
            continue
        logs, cells = (
            np.log(before.depths1[rows] / after.depths0[rows]),
            cells_of(view.keys[rows], 6),
        )
        agreeing, others = (
            np.abs(logs - ratio) < RATIO_WIDTH,
            np.abs(logs - ratio) > 2 * RATIO_WIDTH,
        )
        rivals = [others & (np.abs(logs - log) < RATIO_WIDTH) for log in logs[others]]
        worst = max(doubt(agreeing, rival, cells) for rival in [np.zeros_like(others), *rivals])
        doubts.append(worst * (1 + np.ptp(logs) / (2 * RATIO_WIDTH)))
    return 2 * min(doubts)


def votes(before: Step, after: Step, keys: np.ndarray) -> tuple[int, int, float]:
    """Keypoints of the frame between two steps that agree on the ratio of their lengths, cells of
    the sphere that these are in, of which the ratio has most, and its logarithm."""
    both = np.isfinite(before.depths1) & np.isfinite(after.depths0)
    if np.count_nonzero(both) < 3:
        return 0, 0, 0.0
    logs, cells = np.log(before.depths1[both] / after.depths0[both]), cells_of(keys[both], 6)
    near = np.abs(logs[:, None] - logs) < RATIO_WIDTH
    most = max(near, key=lambda some: (len(np.unique(cells[some])), np.count_nonzero(some)))
    ratio = float(np.median(logs[most]))
    agreeing = np.abs(logs - ratio) < RATIO_WIDTH
    return int(np.count_nonzero(agreeing)), len(np.unique(cells[agreeing])), ratio


def best_chain(steps: list[list[Step]], views: list[View]) -> list[Step]:
    """The best hypothesis of each step, all steps at once."""
    total, back = np.array([2 * np.log(s.rank) for s in steps[0]]), []
    for k in range(1, len(steps)):
        found = [[votes(a, b, views[k].keys) for b in steps[k]] for a in steps[k - 1]]
        tie = [
            [np.log1p(n) + np.log1p(c) - (r / LENGTH_SIGMA) ** 2 / 2 for n, c, r in row]
            for row in found
        ]
        total = total[:, None] + np.array(tie)
        back.append(total.argmax(axis=0))
        total = total.max(axis=0) + np.array([2 * np.log(s.rank) for s in steps[k]])
    chain = [int(total.argmax())]
    for came_from in back[::-1]:
        chain.append(int(came_from[chain[-1]]))
    return [found[c] for found, c in zip(steps, chain[::-1], strict=True)]


def certain(chain: list[Step], steps: list[list[Step]], views: list[View]) -> list[bool]:
    """True for steps that are in doubt neither by a rival nor as places that repeat."""
    sure = []
    for f, step in enumerate(chain):
        behind, repeated = doubts_of_step(step, steps[f], views[f], views[f + 1])
        sure.append(behind < MAX_DOUBT and repeated > MAX_DOUBT)
    return sure


def maps_of(chain: list[Step], sure: list[bool], views: list[View]) -> list[tuple[int, np.ndarray]]:
    """First frame and poses (F, 4, 4) of each map of three frames and more: of certain steps with
    certain ratios of their lengths."""
    found, first = [], 0
    for f in range(1, len(chain) + 1):
        tied = f < len(chain) and sure[f - 1] and sure[f]
        if tied and doubt_of_ratio(chain[f - 1], chain[f], views[f]) < MAX_DOUBT_OF_RATIO:
            continue
        if f - first >= 2:
            some, seen = chain[first:f], views[first : f + 1]
            beside = zip(some, some[1:], seen[1:], strict=False)
            logs = [votes(before, after, view.keys)[2] for before, after, view in beside]
            found.append((first, adjusted(metric_chain(some, np.array(logs)), some, seen)))
        first = f
    return found


def metric_chain(steps: list[Step], logs: np.ndarray) -> np.ndarray:
    """Poses (F, 4, 4) of the frames, the first step having length one."""
    f0_T_f1s = inverse(np.array([step.f1_T_f0 for step in steps]))
    f0_T_f1s[:, :3, 3] *= np.exp(np.r_[0.0, np.cumsum(logs)])[:, None]
    return chained(f0_T_f1s)


def adjusted(poses: np.ndarray, steps: list[Step], views: list[View]) -> np.ndarray:
    """Poses (F, 4, 4) by bundle adjustment of all keypoints that were found in a neighbour; those
    found in both are points of three frames."""
    frames, points, rays, starts = [], [], [], []
    lengths = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    for f, view in enumerate(views):
        beside = []  # neighbour, depths and rays of the frame's keys by the step to it
        if f:
            beside.append((f - 1, steps[f - 1].depths1 * lengths[f - 1], steps[f - 1].places0))
        if f < len(steps):
            beside.append((f + 1, steps[f].depths0 * lengths[f], steps[f].places1))
        logs = np.log([depths for _, depths, _ in beside])
        known = np.isfinite(logs)
        agree = known.any(axis=0) & ~(np.ptp(logs, axis=0) > 0.5)  # true where one is unknown
        for n in np.flatnonzero(agree):
            depth = np.exp(logs[known[:, n], n].mean())
            for g, ray in [(f, view.keys[n]), *((g, seen[n]) for g, _, seen in beside)]:
                if np.isfinite(ray[0]):
                    frames.append(g)
                    points.append(len(starts))
                    rays.append(ray)
            starts.append(poses[f, :3, :3] @ view.keys[n] * depth + poses[f, :3, 3])
    keys, values = [gsba.X(f) for f in range(len(poses))], gtsam.Values()
    for key, one in zip(keys, poses, strict=True):
        values.insert(key, gtsam.Pose3(one))
    graph, first = gtsam.NonlinearFactorGraph(), gtsam.Pose3(poses[0])
    fixed = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
    graph.add(gtsam.PriorFactorPose3(keys[0], first, fixed))
    # points leave the scale open
    loose = gtsam.noiseModel.Diagonal.Sigmas(np.r_[np.full(3, 10.0), np.full(3, 0.1)])
    step = first.between(gtsam.Pose3(poses[1]))
    graph.add(gtsam.BetweenFactorPose3(keys[0], keys[1], step, loose))
    term = BearingTerm(np.array(frames), np.array(points), np.array(rays), SIGMA_RAD)
    world = np.array(starts)
    for scale in (3.0, 1.0):
        block = LandmarkBlock(keys, world, [term], RobustLoss("cauchy", scale))
        values = gsba.optimize(graph, values, [block]).values
        world = block.points_world
    return np.array([values.atPose3(key).matrix() for key in keys])


def row_of(tour: Path) -> str:
    """The table's row of a tour; its steps are printed."""
    views, truth = load(tour)
    began, true_poses, steps, right = time.process_time(), truth.world_T_rigs, [], []
    for i in range(len(views) - 1):
        true = inverse(true_poses[i + 1]) @ true_poses[i]
        found = steps_between(views[i], views[i + 1])
        steps.append(found)
        off = [errors(step.f1_T_f0, true) for step in found]
        right.append([turn < 1 and direction < 3 for turn, direction in off])
        cells = [
            f"{s.rank:.0f} ({s.num}) {a:.2f}/{b:.2f}" for s, (a, b) in zip(found, off, strict=True)
        ]
        print(i, *cells, sep="  ", flush=True)
    cpu = time.process_time() - began
    chain = best_chain(steps, views)
    wrong = [
        i
        for i, (found, good) in enumerate(zip(steps, right, strict=True))
        if not good[next(n for n, one in enumerate(found) if one is chain[i])]
    ]
    lead = [
        max(s.rank for s, ok in zip(found, good, strict=True) if ok)
        / max([s.rank for s, ok in zip(found, good, strict=True) if not ok] or [1.0])
        for found, good in zip(steps, right, strict=True)
        if any(good)
    ]
    maps = []
    sure = certain(chain, steps, views)
    for first, poses in maps_of(chain, sure, views):
        rows = slice(first, first + len(poses))
        true = Trajectory(truth.timestamps[rows], true_poses[rows])
        off = pose_errors(Trajectory(true.timestamps, poses), true).positions
        extent = np.linalg.norm(np.ptp(true_poses[rows, :3, 3], axis=0))
        ate = np.sqrt(np.mean(off**2)) / extent
        maps.append(f"{first} to {first + len(poses) - 1}: {1e3 * ate:.1f}e-3")
    numbers = [sum(map(any, right)), sum(good[0] for good in right), len(steps) - len(wrong)]
    cells = [tour.name, len(steps), *numbers, f"{min(lead):.1f}, {np.median(lead):.1f}"]
    cells += [", ".join(map(str, wrong)) or "none", sum(sure), sum(sure[i] for i in wrong)]
    cells += ["; ".join(maps) or "none", f"{cpu:.0f}"]
    return f"| {' | '.join(map(str, cells))} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("tours", type=Path, nargs="+")
    options = parser.parse_args()
    lines = [
        "| tour | steps | a hypothesis is right | first is right | right in the chain | "
        "lead of right ones: least, median | wrong steps | certain steps | wrong ones of these | "
        "maps: frames, ATE of extent | CPU s |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for tour in options.tours:
        lines.append(row_of(tour))
        print(lines[-1], flush=True)
    write_table(lines, options.out)


if __name__ == "__main__":
    main()
