"""A finished run as a map to localise in: its keyframes' keypoints with the points they show."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from factors.sphere_field import SphereField
from gsba import learned
from gsba.bundle.point_covariances import point_covariances
from gsba.bundle.stitching import corrected
from gsba.camera.cameras import Cameras
from gsba.camera.rig import CubeRig
from gsba.config import RefineSettings
from gsba.config_file import load_config
from gsba.features.detection import Extractor, extract, gather
from gsba.frames import cubemap
from gsba.localization.known_points import PointSightings
from gsba.log import GsbaError
from gsba.matching.guided_search import Searchable, principal_axes, searchable
from gsba.store.finished import load_cameras, load_run
from gsba.store.folder import STAGES, read_marker
from gsba.store.records import RecordError, load_record
from gsba.types import Features, FrameSet, Reconstruction
from gsba.types.records import with_rows
from gsba.version import __version__

# Stages that store keypoints of frames, the last one first.
FEATURE_STAGES = "features_closer", "features_tour", "features"
SAME_PLACE_SIGMAS = 6.0  # largest angle between a keypoint and the observation of a point that is
# taken for the keypoint's, standard deviations of the keypoint
SAME_PLACE_RAD = np.deg2rad(0.25)  # and largest such angle


@dataclass(frozen=True, slots=True)
class MapKeyframe:
    """A frame of the map: the keypoints that show points of the map."""

    features: Features  # (K)
    strongest: Searchable  # the strongest of each face, prepared for matching
    all: Searchable  # all of them, prepared for matching
    points_rig: np.ndarray  # (K, 3) float64, point of each keypoint, rig frame, map units
    points: np.ndarray  # (K,) int64, its number


@dataclass(frozen=True, slots=True)
class Query:
    """Keypoints of a picture to localise, prepared for matching."""

    features: Features
    bearings: np.ndarray  # (K, 3) unit, corrected directions of the keypoints, rig frame
    origins_rig: np.ndarray | None  # (K, 3) origins of their rays; None = the centre
    strongest: Searchable
    all: Searchable


@dataclass(frozen=True, slots=True)
class RunMap:
    """Poses and points of one map of a finished run, and what reads the keypoints of its frames.

    The run's folder is only read.
    """

    root: Path  # folder of the run
    frames: FrameSet  # frames of the map
    result: Reconstruction  # their poses, and the points
    cameras: Cameras  # that see the frames
    fields: tuple[SphereField, ...]  # (C,) of what stitching bends in each camera's pictures
    settings: RefineSettings  # of the run
    rig: CubeRig  # faces on which keypoints of the first camera's frames are found
    point_covariances: np.ndarray  # (J, 3, 3) float64, map units^2, of points given the poses
    axes: np.ndarray  # (D, D) float32, axes of descriptors, see `searchable`
    load_features: Callable[[int], Features]  # keypoints of a frame, by its number, without those
    # that are extracted at weak frames later
    load_keyframe: Callable[[int], MapKeyframe]  # by the number of the frame; recent ones are kept

    @classmethod
    def open(cls, root: Path, map_number: int = 1) -> "RunMap":
        """Read a map of a finished run, 1 = the largest; GsbaError for no finished run, one of
        another version of gsba, or one without points."""
        require_own_version(root)
        result, frames = load_run(root, map_number)
        if not len(result.points_world):
            raise GsbaError(
                f"{root} has no points (its camera turned on the spot): nothing can be localised "
                "in it"
            )
        settings = load_config(root / "config.toml")
        cameras = load_cameras(root, result, frames, map_number)
        rig = cubemap.rig_for(frames.formats[0], settings.cubemap)
        raw = without_correction(frames)  # keypoints are corrected later

        def features_of(f: int, stages: Sequence[str]) -> Features:
            """Keypoints of a frame: those that a stage stored, the first that has, else anew."""
            for stage in stages:
                with suppress(RecordError):
                    return load_record(root / STAGES / stage / f"{frames.names[f]}.npz", Features)
            make = learned.make_extractor(settings.features, learned.find_weights(settings))
            own = cubemap.rig_for(raw.format_of(f), settings.cubemap)
            return extract(*cubemap.load(raw, f, own), own, make())

        first = features_of(0, FEATURE_STAGES).descriptors
        if not len(first):
            raise GsbaError(f"{root}: its first frame has no keypoints: refine again with --fresh")
        axes, observed = principal_axes(first), result.observations_by_frame()
        fields = tuple(SphereField(np.array(kind.correction)) for kind in frames.formats)

        def keyframe(f: int) -> MapKeyframe:
            """Keypoints of a frame that lie where the frame observes a point of the map."""
            from scipy.spatial import KDTree

            features, rows, lenses = features_of(f, FEATURE_STAGES), observed[f], cameras.at(f)
            seen = corrected(gather([features]), fields[frames.cameras[f]], rig)
            seen = Cameras((lenses.of_frame(f),)).seen(seen) if lenses else seen
            numbers = np.zeros(len(features), np.int64)
            known = np.zeros(len(features), bool)
            if len(rows) and len(features):
                gaps, nearest = KDTree(result.observation_bearings[rows]).query(seen.bearings_rig)
                allowed = np.minimum(SAME_PLACE_SIGMAS * seen.sigmas_rad, SAME_PLACE_RAD)
                known = np.asarray(gaps) < allowed
                numbers = result.observation_points[rows].astype(np.int64)[np.asarray(nearest)]
            chosen = np.flatnonzero(known)
            kept, numbers = with_rows(features, chosen), numbers[chosen]
            world_T_rig = result.world_T_rigs[f]
            points = (result.points_world[numbers] - world_T_rig[:3, 3]) @ world_T_rig[:3, :3]
            strongest = searchable(kept, axes, settings.pairs.strongest_per_face)
            return MapKeyframe(kept, strongest, searchable(kept, axes), points, numbers)

        load = lru_cache(64)(keyframe)  # keyframes kept in memory
        known = rig, point_covariances(result), axes
        first_look = partial(features_of, stages=("features",))
        return cls(root, frames, result, cameras, fields, settings, *known, first_look, load)

    def nearest(self, world_T_rig: np.ndarray, most: int) -> np.ndarray:
        """The keyframes (N,) nearest to a pose (4, 4), the nearest first."""
        positions = self.result.world_T_rigs[:, :3, 3]
        distances = np.linalg.norm(positions - world_T_rig[:3, 3], axis=1)
        return np.argsort(distances, kind="stable")[:most]

    def shown(self, directions: np.ndarray, frames: np.ndarray) -> np.ndarray:
        """Directions (N, 3) in which pictures of frames (N,) show unit directions (N, 3)."""
        if not any(self.fields):
            return directions
        cameras, found = self.frames.cameras[frames], directions.copy()
        for camera, field in enumerate(self.fields):
            own = cameras == camera
            found[own] = field.observed(directions[own])
        return found

    def sightings(
        self,
        points: np.ndarray,
        measured: np.ndarray,
        spreads: np.ndarray,
        origins_rig: np.ndarray | None = None,
        camera: int | None = None,
    ) -> PointSightings:
        """Points (N,) of the map in a picture; for the rest see `PointSightings`."""
        positions, covariances = self.result.points_world[points], self.point_covariances[points]
        return PointSightings(positions, covariances, measured, spreads, origins_rig, camera)

    def make_extractor(self) -> Extractor:
        """Extractor of the kind that found the run's keypoints."""
        weights = learned.find_weights(self.settings)
        return learned.make_extractor(self.settings.features, weights)()


def without_correction(frames: FrameSet) -> FrameSet:
    """The frames as their cameras' pictures show them."""
    return frames.with_formats([replace(kind, correction=()) for kind in frames.formats])


def require_own_version(root: Path) -> None:
    """Refuse a run that another version of gsba made."""
    version = read_marker(root).get("gsba", __version__)
    if version != __version__:
        raise GsbaError(
            f"{root} is a run of gsba {version}, this is gsba {__version__}: refine it again with "
            f"--out {root}, or use gsba {version}"
        )
