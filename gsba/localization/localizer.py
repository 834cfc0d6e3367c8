"""Localisation of new frames in a finished run: recognised places, known points, a pose fit."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from factors.sphere_image import SphereImage
from gsba.bundle.stitching import corrected
from gsba.camera.cameras import Cameras
from gsba.camera.lens import ONE_CENTRE, Lenses
from gsba.camera.rig import CubeRig, owner_faces
from gsba.camera.sphere import dense_enough
from gsba.features.detection import extract, gather, traits_of
from gsba.frames import cubemap
from gsba.frames.files import image_size
from gsba.frames.panorama import fitted_to, load_grey
from gsba.geometry import adjoint, inverse
from gsba.localization.known_points import (
    COARSE,
    FINE,
    GATE_SIGMAS,
    PointSightings,
    PoseFit,
    fit,
    is_determined,
    isotropic,
)
from gsba.localization.patch_sightings import PatchAligner
from gsba.localization.picture_cameras import PictureCameras
from gsba.localization.pictures import load_panorama
from gsba.localization.place_index import PlaceIndex, index_path, load_or_make, make_index
from gsba.localization.pose_search import Candidates, PlacedPose, best_of, search_poses
from gsba.localization.run_map import Query, RunMap, without_correction
from gsba.localization.surroundings import Surroundings, open_rates
from gsba.log import GsbaError
from gsba.matching.absolute_pose import is_significant
from gsba.matching.guided_search import Gate, match_pair, searchable
from gsba.trajectory.limits import TwoViewLimits
from gsba.types import Features, FrameSet, Keypoints
from gsba.types.records import with_rows

_NUM_PLACES = 5  # keyframes that look most like a frame
NUM_NEAREST = 10  # keyframes whose points are searched along predicted bearings
_MAX_FACE_PX = 288  # across the faces on which keypoints of panoramas are found: they serve to find
# the place, and cost in proportion to the area
_WIDE_GATE_RAD, _NARROW_GATE_RAD = np.deg2rad(1.0), np.deg2rad(0.4)  # around predicted bearings
_MIN_POINTS = 20  # inliers of a fit

Grey = tuple[np.ndarray, np.ndarray | None]  # (h, 2h) uint8 panorama, and mask, True = use

NO_PLACE = "no place of the map looks like it"
NOT_DETERMINED = "the points that it shows do not determine its pose"


@dataclass(frozen=True, slots=True)
class LocalizedFrame:
    """A frame in a run's map, or the reason why it is not found there."""

    name: str
    world_T_rig: np.ndarray  # (4, 4) float64, world of the run, map units; NaN = not localised
    covariance: np.ndarray  # (6, 6) float64, tangent [rotation rad, translation], rig frame; that
    # of the nearest keyframe in the map is part of it; NaN = not localised
    num_points: int  # points of the map that it shows
    noise_rad: float  # standard deviation of its keypoints per axis; NaN = not localised
    nearest: str  # name of the nearest keyframe; "" = not localised
    reason: str  # why it is not localised; "" = it is
    camera: int | None = None  # number of a photo's camera; None = a panorama

    @property
    def found(self) -> bool:
        """True if the frame is localised."""
        return not self.reason

    @classmethod
    def refused(cls, name: str, reason: str) -> "LocalizedFrame":
        """A frame that is not localised."""
        nothing = np.full((4, 4), np.nan), np.full((6, 6), np.nan)
        return cls(name, *nothing, 0, np.nan, "", reason)


class Localizer:
    """Localises pictures of the run's cameras; open it once, then localise one after the other.

    Of several cameras, a picture is of the one that has its layout and size.

    Args:
        run: folder of a finished run, which is only read. The index of its places is kept beside
            it, in the folder RUN-index.
        map_number: number of the map to localise in, 1 = the largest.
        precise: also align patches of the nearest keyframes to each picture, which takes longer
            and is about three times as accurate.
        camera_of: recording whose camera took the pictures; None = their layout and size tell.

    Raises:
        GsbaError: no finished run, one of another version of gsba, or no such recording.
    """

    def __init__(
        self,
        run: Path | str,
        map_number: int = 1,
        precise: bool = False,
        camera_of: str | None = None,
    ) -> None:
        self.map = RunMap.open(Path(run), map_number)
        path = index_path(self.map.root)
        self.index = load_or_make(self.map, path, PlaceIndex, lambda: make_index(self.map))
        self.extractor = self.map.make_extractor()
        self.cameras = PictureCameras.of(self.map.root, self.map.frames, camera_of)
        self._precise = precise
        self.surroundings = Surroundings(self.map)
        rigs = [cubemap.rig_for(kind, self.map.settings.cubemap) for kind in self.cameras.formats]
        rigs = [
            CubeRig(_MAX_FACE_PX, rig.hfov_rad)
            if kind.panoramic and rig.size > _MAX_FACE_PX
            else rig
            for kind, rig in zip(self.cameras.formats, rigs, strict=True)
        ]
        self.usual = open_rates(self.surroundings, rigs, self._extract, self.query_of)
        self._rigs = [
            CubeRig(size, rig.hfov_rad)
            for size, rig in zip(self.usual.face_px.tolist(), rigs, strict=True)
        ]
        self.aligner = PatchAligner(self.map)

    def localize(self, image: Path | str | np.ndarray, name: str = "") -> LocalizedFrame:
        """Pose of one panorama of a camera of the run.

        Args:
            image: file, or (H, 2H, 3) uint8 RGB.
            name: of the frame; default: the file's.

        Raises:
            GsbaError: the image cannot be read, or is no panorama like those of the run.
        """
        if isinstance(image, np.ndarray):
            if image.ndim != 3 or image.shape[1] != 2 * image.shape[0] or image.shape[2] != 3:
                raise GsbaError(
                    f"an image of shape {image.shape} is no panorama: (H, 2H, 3) is needed"
                )
            camera = self.cameras.of_panorama(image.shape[1], image.shape[0], name or "image")
            return self._localize_panorama(image, name or "image", camera)
        path = Path(image)
        camera = self.cameras.of_panorama(*image_size(path), str(path))
        width = round(2 * np.pi * self._rigs[camera].focal)
        erp = load_panorama(path, max(width, self._precise * self.aligner.width))
        return self._localize_panorama(erp, name or path.stem, camera)

    def localize_frame(
        self, frames: FrameSet, frame: int, camera: int | None = None
    ) -> LocalizedFrame:
        """Pose of one frame of a scanned folder, with its mask.

        Args:
            camera: of the run, that took it; None = that of its layout and size.

        Raises:
            GsbaError: images that cannot be read, or are of no camera of the run.
        """
        name = frames.names[frame]
        if camera is None:
            camera = self.cameras.of_frames(frames.format_of(frame), name)
        features = self._extract(frames, frame, self._rigs[camera])
        raw, width = without_correction(frames), self.aligner.width

        def grey() -> Grey:
            return load_grey(raw, frame, width)

        return self._localize_features(name, features, grey, camera)

    def _extract(self, frames: FrameSet, frame: int, rig: CubeRig) -> Features:
        images, masks = cubemap.load(without_correction(frames), frame, rig)
        return extract(images, masks, rig, self.extractor)

    def _localize_panorama(self, erp: np.ndarray, name: str, camera: int) -> LocalizedFrame:
        import cv2

        def grey() -> Grey:
            return fitted_to(cv2.cvtColor(erp, cv2.COLOR_RGB2GRAY), self.aligner.width), None

        rig, small = self._rigs[camera], erp
        width = dense_enough(erp.shape[1], rig.focal)
        if width < erp.shape[1]:
            small = cv2.resize(erp, (width, width // 2), interpolation=cv2.INTER_AREA)
        features = extract(cubemap.cut(small, rig), None, rig, self.extractor)
        return self._localize_features(name, features, grey, camera)

    def _localize_features(
        self, name: str, features: Features, load: Callable[[], Grey], camera: int
    ) -> LocalizedFrame:
        query = self.query_of(features, camera, self._rigs[camera])
        found = self._recognise(name, query, camera)
        if self._precise and found.found:
            found = self._on_patches(found, load, camera)
        return self.with_map_error(found) if found.found else found

    def _recognise(self, name: str, query: Query, camera: int) -> LocalizedFrame:
        """A camera's frame at the place that explains it best of those that look like it."""
        settings, reason = self.map.settings, NO_PLACE
        places = self.index.nearest_panoramas(query.all.descriptors, 16)
        max_error = np.deg2rad(TwoViewLimits.of(settings).max_error_deg)
        frames, poses = list[LocalizedFrame](), list[PlacedPose]()
        for strongest, chosen in ((True, places[:_NUM_PLACES]), (False, places)):
            candidates = self.candidates_of(query, chosen, strongest)
            for start in search_poses(candidates, max_error, settings.seed, 5):
                frame, placed = self._placed(name, query, start.world_T_rig, camera)
                if placed is None:
                    reason = frame.reason
                    continue
                frames.append(frame)
                poses.append(placed)
            if poses:
                best, reason = best_of(poses)
                if not reason:
                    return frames[best]
        return LocalizedFrame.refused(name, reason)

    def _placed(
        self, name: str, query: Query, world_T_rig: np.ndarray, camera: int
    ) -> tuple[LocalizedFrame, PlacedPose | None]:
        """A camera's frame fitted to the points around a pose; None if they do not determine it."""
        fitted, seen, candidates = None, None, None
        for gate, scales in ((_WIDE_GATE_RAD, COARSE), (_NARROW_GATE_RAD, FINE)):
            candidates = self.candidates_around(query, world_T_rig, gate)
            if len(candidates) < _MIN_POINTS:
                return LocalizedFrame.refused(name, NO_PLACE), None
            rows, origins = candidates.keypoints, query.origins_rig
            seen = self.map.sightings(
                candidates.points,
                query.bearings[rows],
                isotropic(query.features.sigmas_rad[rows]),
                None if origins is None else origins[rows],
            )
            fitted = fit([seen], world_T_rig[None], scales)
            world_T_rig = fitted.world_T_rigs[0]
        assert fitted is not None and seen is not None and candidates is not None
        frame = self._judged(name, fitted, seen, candidates)
        if not frame.found:
            return frame, None
        usual = self.usual.of_camera(camera)
        evidence = self.surroundings.evidence(query, world_T_rig, usual)
        agreeing = with_rows(candidates, fitted.inliers[0])
        points, bearings = agreeing.points_world, agreeing.bearings
        return frame, PlacedPose.of(world_T_rig, points, bearings, evidence)

    def with_map_error(self, frame: LocalizedFrame) -> LocalizedFrame:
        """The frame with the uncertainty of the map around it, which its nearest keyframe has."""
        nearest, result = int(self.map.nearest(frame.world_T_rig, 1)[0]), self.map.result
        uncertain = result.pose_covariances[nearest]
        if not np.isfinite(uncertain).all():
            return frame
        rig_T_keyframe = inverse(frame.world_T_rig) @ result.world_T_rigs[nearest]
        carried = adjoint(rig_T_keyframe[None])[0]
        return replace(frame, covariance=frame.covariance + carried @ uncertain @ carried.T)

    def _on_patches(
        self, frame: LocalizedFrame, load: Callable[[], Grey], camera: int
    ) -> LocalizedFrame:
        """The frame of a camera fitted to aligned patches; as it was if too few align."""
        grey, mask = load()
        image, lenses = SphereImage.of(grey, smooth=True), self._own_lenses(camera)
        field = self.map.fields[camera]
        places = self.map.nearest(frame.world_T_rig, NUM_NEAREST)
        expected = self.aligner.expected(frame.world_T_rig, places)
        found = self.aligner.align(expected, frame.world_T_rig, image, mask, field, lenses)
        if len(found.points) < _MIN_POINTS:
            return frame
        bearings, origins = field.corrected(found.bearings), None
        if lenses:
            bearings, origins = lenses.rays(bearings, np.zeros(len(bearings), np.int64))
        seen = self.map.sightings(found.points, bearings, found.covariances, origins)
        fitted = fit([seen], frame.world_T_rig[None], FINE)
        world_T_rig, num = fitted.world_T_rigs[0], int(fitted.inliers[0].sum())
        if not np.isfinite(fitted.covariances[0]).all() or num < _MIN_POINTS:
            return frame
        noise = float(fitted.noises[0]) * typical_sigma(found.covariances)
        return self.frame_at(frame.name, world_T_rig, fitted.covariances[0], num, noise)

    def _own_lenses(self, camera: int) -> Lenses:
        """Lenses of a picture whose motion during the readout is not known."""
        lenses = self.map.cameras.lenses[camera]
        if not lenses or lenses.axes is not None:  # nothing says how the lenses lie in it
            return ONE_CENTRE
        return replace(lenses, readout_motion=None)

    def query_of(self, features: Features, camera: int, rig: CubeRig) -> Query:
        """Keypoints of a camera's picture on faces of a rig, ready to be matched, where they
        really point."""
        map_ = self.map
        seen: Keypoints = corrected(gather([features]), map_.fields[camera], rig)
        origins = None
        if lenses := self._own_lenses(camera):
            seen = Cameras((lenses,)).seen(seen)
            origins = seen.origins_rig
        ready = replace(
            features, bearings_rig=seen.bearings_rig, faces=owner_faces(seen.bearings_rig)
        )
        strongest = map_.settings.pairs.strongest_per_face
        few, every = searchable(features, map_.axes, strongest), searchable(ready, map_.axes)
        return Query(features, seen.bearings_rig, origins, few, every)

    def candidates_of(self, query: Query, places: np.ndarray, strongest: bool) -> Candidates:
        """Points of keyframes (N,) that look like keypoints, wherever they are."""
        chosen = traits_of(self.map.settings)

        def match(place: int) -> np.ndarray:
            keyframe = self.map.load_keyframe(place)
            first = keyframe.strongest if strongest else keyframe.all
            second = query.strongest if strongest else query.all
            return match_pair(first, second, np.eye(4), Gate.anywhere(), chosen)

        return self._gathered(query, places, match)

    def candidates_around(
        self,
        query: Query,
        world_T_rig: np.ndarray,
        gate_rad: float,
        recognised: np.ndarray | None = None,
    ) -> Candidates:
        """Points of the nearest keyframes, and those `recognised` (N,), that look like keypoints
        within `gate_rad` of their predicted bearing from a pose (4, 4)."""
        poses, places = self.map.result.world_T_rigs, self.map.nearest(world_T_rig, NUM_NEAREST)
        if recognised is not None:
            places = np.union1d(places, recognised)
        gate, chosen = Gate.around_points(gate_rad), traits_of(self.map.settings)

        def match(place: int) -> np.ndarray:
            keyframe, f0_T_f1 = self.map.load_keyframe(place), inverse(poses[place]) @ world_T_rig
            known = keyframe.points_rig
            return match_pair(keyframe.all, query.all, f0_T_f1, gate, chosen, known)

        return self._gathered(query, places, match)

    def _gathered(
        self, query: Query, places: np.ndarray, match: Callable[[int], np.ndarray]
    ) -> Candidates:
        """Pairs of a keypoint and a point, each once, from the matches with several keyframes."""
        pairs = [np.zeros((0, 2), np.int64)]
        for place in places.tolist():
            found = match(place)
            points = self.map.load_keyframe(place).points[found[:, 0]]
            pairs.append(np.column_stack([found[:, 1], points]))
        keypoints, points = np.unique(np.concatenate(pairs), axis=0).T
        positions = self.map.result.points_world[points]
        return Candidates(keypoints, query.bearings[keypoints], points, positions)

    def _judged(
        self, name: str, fitted: PoseFit, seen: PointSightings, candidates: Candidates
    ) -> LocalizedFrame:
        """The frame with its pose, if that is significant and determined."""
        inliers, covariance = fitted.inliers[0], fitted.covariances[0]
        world_T_rig, noise = fitted.world_T_rigs[0], float(fitted.noises[0])
        sigma = noise * typical_sigma(seen.spreads)
        chance = (GATE_SIGMAS * sigma / _NARROW_GATE_RAD) ** 2
        if not is_significant(candidates.bearings, inliers, chance):
            return LocalizedFrame.refused(name, NO_PLACE)
        if not is_determined(world_T_rig, covariance, candidates.points_world[inliers]):
            return LocalizedFrame.refused(name, NOT_DETERMINED)
        num = len(np.unique(candidates.points[inliers]))
        return self.frame_at(name, world_T_rig, covariance, num, sigma)

    def frame_at(
        self,
        name: str,
        world_T_rig: np.ndarray,
        covariance: np.ndarray,
        num_points: int,
        noise_rad: float,
        camera: int | None = None,
    ) -> LocalizedFrame:
        """A frame in the map, and its nearest keyframe."""
        nearest = self.map.frames.names[int(self.map.nearest(world_T_rig, 1)[0])]
        given = world_T_rig, covariance, num_points, noise_rad, nearest
        return LocalizedFrame(name, *given, reason="", camera=camera)


def typical_sigma(covariances: np.ndarray) -> float:
    """Median standard deviation per axis of covariances (N, 2, 2)."""
    return float(np.median(np.linalg.det(covariances) ** 0.25))
