"""Visual odometry on the sphere: a pose for each of a sequence of small grey panoramas.

Features of the last keyframe are tracked into each frame; the frame's pose comes from those with
known points (resection). A frame with enough parallax, or too few features, becomes a keyframe: new
features are added, all of the window are triangulated again and adjusted together. Frames are
stored relative to their keyframes, and move with them.
"""

import logging
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from gsba.geometry import angles_between, inverse, nearest_rotation, pose, rotation_angle, unit
from gsba.odometry.atlas import Atlas, AtlasLayout, Cutter, follow, new_corners
from gsba.odometry.derotation import Miniature, miniature, turned
from gsba.odometry.relocalisation import Described, describe, placed
from gsba.odometry.resection import Resection, resect
from gsba.odometry.tracker_state import (
    FrameRecord,
    FrameStatus,
    Keyframe,
    TrackedFeatures,
    TrackerState,
)
from gsba.odometry.window import (
    GATE,
    AdjustedWindow,
    WindowObservations,
    adjust_window,
    median_turn,
    start_map,
)
from gsba.types.records import with_rows

logger = logging.getLogger(__name__)

FREE, HELD = 8, 5  # keyframes of the window that are adjusted, and fixed ones before them
_MIN_CONTRAST = 1.5  # grey values: a lower contrast is darkness, or a hand over the lenses
_START_SHARE = 0.45  # share of the first keyframe's features below which initialisation restarts
_MIN_SIGMA, _MAX_SIGMA = np.deg2rad([0.05, 0.35])  # noise of bearings, per axis
_NUDGE_R = Rotation.from_rotvec(np.deg2rad([1.2, 1.2, 1.2])).as_matrix()  # its rotation
_MIN_FEATURES = 40  # least number of features of a picture that shows a scene


@dataclass(frozen=True, slots=True)
class _Attempt:
    """Bearings of the features in a frame, and the pose they give."""

    atlas: Atlas
    bearings: np.ndarray  # (N, 3)
    found: np.ndarray  # (N,) bool
    fit: Resection


@dataclass(slots=True)
class Tracker:
    """State of the odometry between frames."""

    width: int  # pixels across the panoramas
    usable: np.ndarray | None = None  # (h, 2h) bool, pixels that show the scene in every frame
    seed: int = 0  # of the sampling at the start of a map
    patience: int = 8  # frames with contrast that fit no keyframe before a new map is begun
    state: TrackerState = field(default_factory=TrackerState)  # a stored one is continued

    _layout: AtlasLayout = field(init=False)
    _cutter: Cutter = field(init=False)
    _mask_cutter: Cutter = field(init=False)  # its axes are those of the mask cut last
    _mask: Atlas | None = None  # `usable` as it was cut last

    def __post_init__(self) -> None:
        self._layout = AtlasLayout.of(self.width)
        self._cutter = Cutter(self._layout, self.state.cut_R_rig)
        self._mask_cutter = Cutter(self._layout)

    def world_T_rigs(self) -> np.ndarray:
        """Poses (F, 4, 4) of all frames so far, each in the world of its map."""
        poses = self.state.keyframe_poses
        return np.array([poses[r.keyframe] @ r.key_T_rig for r in self.state.records])

    def add(self, grey: np.ndarray) -> FrameRecord:
        """Pose the next frame, a panorama (width / 2, width) uint8."""
        frame = len(self.state.records)
        small = miniature(grey, self.usable)
        if self.state.features is None:
            self._begin_map(grey, small, frame)
        elif not self.state.has_points:
            self._add_before_start(grey, small, frame)
        else:
            self._add_to_map(grey, small, frame)
        self.state.cut_R_rig = self._cutter.cut_R_rig
        return self.state.records[-1]

    # A frame before the map has points.

    def _begin_map(self, grey: np.ndarray, small: Miniature, frame: int) -> None:
        """Make a frame the first keyframe of a map, if it has enough features."""
        atlas = self._cutter.cut(grey, self.state.world_T_rig[:3, :3])
        corners = self._corners(atlas, np.zeros((0, 3)))
        if len(corners) < _MIN_FEATURES or small.contrast < _MIN_CONTRAST:
            self._record(FrameStatus.LOST, np.eye(4))
            return
        self.state.window = []
        self._add_keyframe(frame, self.state.world_T_rig, atlas, small, None, corners)
        self._record(FrameStatus.TURNING, np.eye(4))
        self.state.small = small

    def _add_before_start(self, grey: np.ndarray, small: Miniature, frame: int) -> None:
        """Track the first keyframe's features until they have enough parallax."""
        key, features = self.state.window[-1], self.state.features
        assert key.atlas is not None and features is not None
        predicted_R = self.state.world_T_rig[:3, :3] @ self.state.motion[:3, :3]
        atlas, bearings, found = self._followed(grey, key, features, predicted_R)
        if np.count_nonzero(found) < _START_SHARE * (key.most_found or len(features.ids)):
            again = self._followed(grey, key, features, self._turned(small, predicted_R))
            if np.count_nonzero(again[2]) > np.count_nonzero(found):
                atlas, bearings, found = again
        ids, one, other = features.ids[found], features.bearings[found], bearings[found]
        if len(ids) < _MIN_FEATURES:
            self._lose(grey, small, frame)
            return
        key.most_found = max(key.most_found, len(ids))
        one_R_other, parallaxes = median_turn(one, other)
        world_R_rig = key.world_T_rig[:3, :3] @ one_R_other
        fading = len(ids) < 0.7 * key.most_found  # less parallax suffices then
        seed = self.seed + frame
        solved = start_map(ids, one, other, parallaxes, self.state.sigma, seed, fading)
        self.state.failures = 0
        if solved is not None:
            self._start(frame, solved, atlas, small, ids, other)
            return
        position = self.state.world_T_rig[:3, 3]
        features.assumed_world[found] = position + bearings[found] @ world_R_rig.T
        self._step(pose(world_R_rig, position), small)
        if len(ids) < _START_SHARE * key.most_found:
            # The camera rotated away from its features, without a step: rotations start from here.
            self.state.pending.clear()
            corners = self._corners(atlas, np.zeros((0, 3)))
            self.state.window = []
            self._add_keyframe(frame, self.state.world_T_rig, atlas, small, None, corners)
            self._record(FrameStatus.TURNING, np.eye(4))
            return
        self.state.pending.append((frame, ids, other))
        del self.state.pending[:-300]  # frames that are posed once the map has points
        self._record(FrameStatus.TURNING, inverse(key.world_T_rig) @ self.state.world_T_rig)

    def _followed(
        self, grey: np.ndarray, key: Keyframe, features: TrackedFeatures, world_R_rig: np.ndarray
    ) -> tuple[Atlas, np.ndarray, np.ndarray]:
        """Atlas, bearings (N, 3) of features and found (N,), tracked at a predicted rotation."""
        assert key.atlas is not None
        atlas = self._cutter.cut(grey, world_R_rig)
        expected = unit((features.assumed_world - self.state.world_T_rig[:3, 3]) @ world_R_rig)
        return atlas, *follow(self._layout, key.atlas, atlas, features.bearings, expected)

    def _start(
        self,
        frame: int,
        solved: AdjustedWindow,
        atlas: Atlas,
        small: Miniature,
        ids: np.ndarray,
        bearings: np.ndarray,
    ) -> None:
        """Give the map its first points, in the world of the first keyframe."""
        key = self.state.window[-1]
        world_T_key = key.world_T_rig
        points = solved.points_world @ world_T_key[:3, :3].T + world_T_key[:3, 3]
        self.state.points[solved.ids] = points
        self.state.has_points = True
        for before, seen, where in self.state.pending:
            points = self.state.points[seen]
            known = np.isfinite(points[:, 0])
            record = self.state.records[before]
            fit = resect(
                points[known], where[known], world_T_key @ record.key_T_rig, self.state.sigma
            )
            if fit.significant:
                record.key_T_rig = inverse(world_T_key) @ fit.world_T_rig
                record.status = FrameStatus.TRACKED
                record.inliers = int(np.count_nonzero(fit.inliers))
                record.distance = self._distance(seen, fit.world_T_rig)
        last = self.state.records[-1]
        self.state.world_T_rig = self.state.keyframe_poses[last.keyframe] @ last.key_T_rig
        self._step(world_T_key @ solved.world_T_rigs[1], small)
        self.state.pending.clear()
        false = np.isin(ids, solved.outliers[:, 1])
        self._become_keyframe(frame, atlas, small, ids[~false], bearings[~false])

    # A frame of a map that has points.

    def _add_to_map(self, grey: np.ndarray, small: Miniature, frame: int) -> None:
        """Pose a frame by known points; if that fails, relocalise it by keyframes."""
        features, key = self.state.features, self.state.window[-1]
        assert features is not None
        tried = self._attempt(grey, key, features, self.state.world_T_rig @ self.state.motion)
        if not tried.fit.significant:
            turned_pose = pose(
                self._turned(small, tried.fit.world_T_rig[:3, :3]), self.state.world_T_rig[:3, 3]
            )
            again = self._attempt(grey, key, features, turned_pose)
            tried = again if again.fit.significant else None
        if tried is None:
            tried = self._relocalised(grey, small)
        if tried is None:
            self._lose(grey, small, frame)
            return
        found_again = self.state.records[-1].status == FrameStatus.LOST
        self.state.failures = 0
        self._accept(frame, tried, small)
        if found_again:  # the step from the last pose before the loss is no velocity
            self.state.motion = np.eye(4)

    def _attempt(
        self, grey: np.ndarray, key: Keyframe, features: TrackedFeatures, predicted: np.ndarray
    ) -> _Attempt:
        """Follow features into a frame of predicted pose (4, 4); badly predicted ones twice."""
        template = key.atlas
        assert template is not None
        atlas = self._cutter.cut(grey, predicted[:3, :3])
        points = self.state.points[features.ids]
        known = np.isfinite(points[:, 0])
        assumed = np.where(known[:, None], points, features.assumed_world)
        bearings, found = np.empty_like(points), np.zeros(len(points), bool)

        def look(rows: np.ndarray, world_T_rig: np.ndarray) -> None:
            expected = _seen_from(world_T_rig, assumed[rows])
            seen = features.bearings[rows]
            bearings[rows], found[rows] = follow(self._layout, template, atlas, seen, expected)

        look(np.flatnonzero(known), predicted)
        rows = np.flatnonzero(known & found)
        fit = resect(points[rows], bearings[rows], predicted, self.state.sigma)
        if np.count_nonzero(fit.inliers) >= 8:
            moved = angles_between(
                _seen_from(predicted, points[rows]), _seen_from(fit.world_T_rig, points[rows])
            )
            if np.median(moved) > np.deg2rad(1.5):
                astray = known.copy()
                astray[rows[fit.inliers]] = False
                look(np.flatnonzero(astray), fit.world_T_rig)
                rows = np.flatnonzero(known & found)
                fit = resect(points[rows], bearings[rows], fit.world_T_rig, self.state.sigma)
        if fit.significant:
            look(np.flatnonzero(~known), fit.world_T_rig)
        return _Attempt(atlas, bearings, found, fit)

    def _accept(self, frame: int, tried: _Attempt, small: Miniature) -> None:
        """Accept the pose of a frame; make it a keyframe if needed."""
        features, key, fit = self.state.features, self.state.window[-1], tried.fit
        assert features is not None
        self._step(fit.world_T_rig, small)
        noise = float(np.clip(fit.noise, _MIN_SIGMA, _MAX_SIGMA))
        self.state.sigma += 0.1 * (noise - self.state.sigma)
        fits = self._fitting(features, tried, key)
        position = self.state.world_T_rig[:3, 3]
        distances = np.linalg.norm(features.assumed_world[fits] - position, axis=1)
        rays = distances[:, None] * (tried.bearings[fits] @ self.state.world_T_rig[:3, :3].T)
        features.assumed_world[fits] = position + rays
        features.misses = np.where(fits, 0, features.misses + 1)
        known = np.isfinite(self.state.points[features.ids, 0])
        distance = self._distance(features.ids[fits & known], self.state.world_T_rig)
        parallax = 0.0
        if fits.any():  # of features' rays in the keyframe and in the frame
            key_R_rig = key.world_T_rig[:3, :3].T @ self.state.world_T_rig[:3, :3]
            rays = tried.bearings[fits] @ key_R_rig.T
            parallax = float(np.median(angles_between(features.bearings[fits], rays)))
        key.most_found = max(key.most_found, int(np.count_nonzero(fits)))
        share = np.count_nonzero(fits) / max(key.most_found, 1)
        few = np.count_nonzero(fit.inliers) < 60 and parallax > np.deg2rad(1.0)
        # median parallax, and share of the last keyframe's features that are still found
        if parallax > np.deg2rad(3.0) or share < 0.7 or few:
            ids, bearings = features.ids[fits], tried.bearings[fits]
            self._become_keyframe(frame, tried.atlas, small, ids, bearings)
            return
        kept = known | (features.misses <= 4)  # consecutive frames
        self.state.features = with_rows(features, kept)
        number = int(np.count_nonzero(fit.inliers))
        key_T_rig = inverse(key.world_T_rig) @ self.state.world_T_rig
        self._record(FrameStatus.TRACKED, key_T_rig, distance, number)

    def _fitting(self, features: TrackedFeatures, tried: _Attempt, key: Keyframe) -> np.ndarray:
        """Features (N,) bool found where the pose permits them."""
        points = self.state.points[features.ids]
        known = np.isfinite(points[:, 0])
        fits = tried.found.copy()
        rows = np.flatnonzero(known & tried.found)
        fits[rows] = tried.fit.inliers
        rows = np.flatnonzero(~known & tried.found)
        key_T_rig = inverse(key.world_T_rig) @ self.state.world_T_rig
        rays = tried.bearings[rows] @ key_T_rig[:3, :3].T
        normals = np.cross(key_T_rig[:3, 3], features.bearings[rows])
        lengths = np.linalg.norm(normals, axis=1)
        across = np.abs(np.sum(normals * rays, axis=1)) / np.maximum(lengths, 1e-12)
        # Near the epipole, and without a step, rays are compared with the bearing itself.
        off = angles_between(features.bearings[rows], rays)
        fits[rows] = np.minimum(across, off) < GATE * self.state.sigma
        return fits

    # Keyframes.

    def _become_keyframe(
        self, frame: int, atlas: Atlas, small: Miniature, ids: np.ndarray, bearings: np.ndarray
    ) -> None:
        """Make the last posed frame a keyframe: add features, adjust the window."""
        corners = self._corners(atlas, bearings)
        self._add_keyframe(frame, self.state.world_T_rig, atlas, small, (ids, bearings), corners)
        # adjust the window, and drop features that do not fit it
        window = self.state.window
        held = max(len(window) - FREE, min(2, len(window) - 1))
        seen = WindowObservations.of([(key.ids, key.bearings) for key in window])
        poses = np.array([key.world_T_rig for key in window])
        solved = adjust_window(poses, held, seen, self.state.sigma)
        for key, world_T_rig in zip(window[held:], solved.world_T_rigs[held:], strict=True):
            key.world_T_rig = world_T_rig
            self.state.keyframe_poses[key.number] = world_T_rig
        everything = np.unique(seen.ids)
        self.state.points[everything] = np.nan
        self.state.points[solved.ids] = solved.points_world
        for n, key in enumerate(window):
            false = solved.outliers[solved.outliers[:, 0] == n, 1]
            if len(false):
                kept = ~np.isin(key.ids, false)
                key.ids, key.bearings = key.ids[kept], key.bearings[kept]
                self.state.keyframe_features[key.number] = key.ids, key.bearings.astype(np.float32)
        last = window[-1]
        self.state.world_T_rig = last.world_T_rig.copy()
        self.state.features = self._followable(last)
        known = np.isfinite(self.state.points[ids, 0])
        distance = self._distance(ids[known], self.state.world_T_rig)
        self._record(FrameStatus.TRACKED, np.eye(4), distance, len(ids))

    def _add_keyframe(
        self,
        frame: int,
        world_T_rig: np.ndarray,
        atlas: Atlas,
        small: Miniature,
        followed: tuple[np.ndarray, np.ndarray] | None,
        corners: np.ndarray,
    ) -> None:
        """Add a keyframe with tracked features (ids, bearings), and new corners."""
        state = self.state
        ids = state.num_ids + np.arange(len(corners))
        state.num_ids += len(corners)
        while state.num_ids > len(state.points):
            state.points = np.concatenate([state.points, np.full_like(state.points, np.nan)])
        bearings = corners
        if followed is not None:
            ids = np.concatenate([followed[0], ids])
            bearings = np.concatenate([followed[1], corners])
        number = len(state.keyframe_poses)
        key = Keyframe(number, frame, world_T_rig.copy(), ids, bearings, atlas, small)
        state.window.append(key)
        state.keyframe_poses.append(key.world_T_rig)
        state.keyframe_frames.append(frame)
        state.keyframe_features.append((ids, bearings.astype(np.float32)))
        del state.window[: -(FREE + HELD)]
        for old in state.window[:-10]:  # keyframes that a lost frame is compared with
            old.atlas = old.small = old.described = None
        state.features = self._followable(key)

    # Lost frames.

    def _relocalised(self, grey: np.ndarray, small: Miniature) -> _Attempt | None:
        """A lost frame posed by one of the last keyframes, which becomes the reference; or None."""
        if small.contrast < _MIN_CONTRAST:
            return None
        for key in reversed(self.state.window):
            if key.atlas is None or key.small is None:
                break
            world_R_rig = key.world_T_rig[:3, :3] @ turned(key.small, small, [np.eye(3)])
            found = self._by_keyframe(grey, key, pose(world_R_rig, key.world_T_rig[:3, 3]))
            if found is not None:
                return found
        frame = self._described(self._cutter.cut(grey, self.state.world_T_rig[:3, :3]))
        for key in reversed(self.state.window[-4:]):  # the last four
            if key.atlas is None:
                break
            if key.described is None:
                key.described = self._described(key.atlas)
            points = self.state.points[key.ids]
            known = np.isfinite(points[:, 0])
            distances = np.linalg.norm(points[known] - key.world_T_rig[:3, 3], axis=1)
            seed = self.seed + len(self.state.records)
            key_T_rig = placed(key.described, frame, key.bearings[known], distances, seed)
            if key_T_rig is None:
                continue
            found = self._by_keyframe(grey, key, key.world_T_rig @ key_T_rig)
            if found is not None:
                return found
        return None

    def _confirmed(
        self, grey: np.ndarray, key: Keyframe, features: TrackedFeatures, tried: _Attempt
    ) -> bool:
        """True if tracking from a perturbed pose leads back to the pose.

        Optical flow of features that are not visible stays near their predictions, and so agrees
        with any pose that predicted them.
        """
        nudge = pose(_NUDGE_R, np.full(3, 0.03 * self._distance(key.ids, tried.fit.world_T_rig)))
        other = self._attempt(grey, key, features, tried.fit.world_T_rig @ nudge)
        if not other.fit.significant:
            return False
        off = inverse(tried.fit.world_T_rig) @ other.fit.world_T_rig
        turned_back = rotation_angle(off[:3, :3]) < 0.3 * rotation_angle(_NUDGE_R)
        moved_back = np.linalg.norm(off[:3, 3]) < 0.3 * np.linalg.norm(nudge[:3, 3])
        return bool(turned_back and moved_back)

    def _by_keyframe(
        self, grey: np.ndarray, key: Keyframe, predicted: np.ndarray
    ) -> _Attempt | None:
        """A frame tracked from a keyframe, which becomes the reference; None without a pose."""
        features = self._followable(key)
        tried = self._attempt(grey, key, features, predicted)
        if tried.fit.significant:
            tried = self._attempt(grey, key, features, tried.fit.world_T_rig)
        known = np.count_nonzero(np.isfinite(self.state.points[key.ids, 0]))
        share = np.count_nonzero(tried.fit.inliers) / max(known, 1)
        if not tried.fit.significant or share < 0.4:  # other doors show some
            return None
        if not self._confirmed(grey, key, features, tried):
            return None
        self.state.window = self.state.window[: self.state.window.index(key) + 1]
        self.state.features = features
        logger.debug("frame %d: found again by keyframe %d", len(self.state.records), key.number)
        return tried

    def _described(self, atlas: Atlas) -> Described:
        return describe(self._layout, atlas, self._usable_in(atlas))

    def _lose(self, grey: np.ndarray, small: Miniature, frame: int) -> None:
        """Leave a frame without a pose; begin a new map after several."""
        state = self.state
        state.motion = np.eye(4)
        state.small = state.small if state.small is not None else small
        key = state.window[-1]
        self._record(FrameStatus.LOST, inverse(key.world_T_rig) @ state.world_T_rig)
        if small.contrast < _MIN_CONTRAST:
            return
        state.failures += 1
        if state.failures < self.patience:
            return
        state.failures = 0
        logger.warning("frame %d: nothing ties it to the map: a new one begins", frame)
        state.records.pop()
        state.map_number += 1
        state.has_points, state.features, state.world_T_rig = False, None, np.eye(4)
        state.pending.clear()
        self._begin_map(grey, small, frame)

    # Helpers.

    def _turned(self, small: Miniature, guess: np.ndarray) -> np.ndarray:
        """Orientation (3, 3) by the whole panorama, relative to the last posed frame."""
        assert self.state.small is not None
        before = self.state.world_T_rig[:3, :3]
        return before @ turned(self.state.small, small, [before.T @ guess, np.eye(3)])

    def _corners(self, atlas: Atlas, known: np.ndarray) -> np.ndarray:
        return new_corners(self._layout, atlas, self._usable_in(atlas), known)

    def _usable_in(self, atlas: Atlas) -> np.ndarray | None:
        if self.usable is None:
            return None
        if self._mask is None or (self._mask.cut_R_rig != atlas.cut_R_rig).any():
            grey = self.usable.astype(np.uint8) * 255
            self._mask = self._mask_cutter.cut(grey, atlas.cut_R_rig, exactly=True)
        return self._mask.image > 250

    def _followable(self, key: Keyframe) -> TrackedFeatures:
        """Features of a keyframe, at the distance of the nearest one with a point."""
        points = self.state.points[key.ids]
        known = np.isfinite(points[:, 0])
        distances = np.ones(len(points))
        if known.any():
            lengths = np.linalg.norm(points[known] - key.world_T_rig[:3, 3], axis=1)
            nearest = np.argmax(key.bearings @ key.bearings[known].T, axis=1)
            distances = lengths[nearest]
        rays = distances[:, None] * (key.bearings @ key.world_T_rig[:3, :3].T)
        assumed = key.world_T_rig[:3, 3] + rays
        return TrackedFeatures(key.ids, key.bearings, assumed, np.zeros(len(rays), int))

    def _distance(self, ids: np.ndarray, world_T_rig: np.ndarray) -> float:
        """Median distance of features' points from a pose; NaN without points."""
        points = self.state.points[ids]
        points = points[np.isfinite(points[:, 0])]
        if not len(points):
            return float("nan")
        return float(np.median(np.linalg.norm(points - world_T_rig[:3, 3], axis=1)))

    def _step(self, world_T_rig: np.ndarray, small: Miniature) -> None:
        """Set pose and motion from the new frame's pose."""
        # A product of products would double the rounding error R^T R - I with every frame.
        motion = inverse(self.state.world_T_rig) @ world_T_rig
        self.state.motion = pose(nearest_rotation(motion[:3, :3]), motion[:3, 3])
        self.state.world_T_rig = pose(nearest_rotation(world_T_rig[:3, :3]), world_T_rig[:3, 3])
        self.state.small = small

    def _record(
        self,
        status: FrameStatus,
        key_T_rig: np.ndarray,
        distance: float = float("nan"),
        inliers: int = 0,
    ) -> None:
        """Append the record of the next frame."""
        state = self.state
        if not state.keyframe_poses:
            state.keyframe_poses.append(np.eye(4))
            state.keyframe_frames.append(len(state.records))
            state.keyframe_features.append((np.zeros(0, np.int64), np.zeros((0, 3), np.float32)))
        key = state.window[-1].number if state.window else len(state.keyframe_poses) - 1
        found = key_T_rig, distance, inliers
        state.records.append(FrameRecord(status, state.map_number, key, *found))


def _seen_from(world_T_rig: np.ndarray, points_world: np.ndarray) -> np.ndarray:
    """Unit bearings (N, 3), rig frame, of points (N, 3) from a pose (4, 4)."""
    return unit((points_world - world_T_rig[:3, 3]) @ world_T_rig[:3, :3])
