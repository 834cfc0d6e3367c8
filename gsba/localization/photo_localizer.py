"""Localisation of perspective photos: pose, focal length, principal point and distortion."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from factors import tangent_basis
from factors.sphere_field import SphereField
from factors.sphere_image import SphereImage
from gsba.camera.lens import ONE_CENTRE
from gsba.camera.projections import PerspectiveProjection
from gsba.camera.rig import owner_faces
from gsba.localization.known_points import (
    COARSE,
    FINE,
    GATE_SIGMAS,
    CameraPrior,
    PointSightings,
    PoseFit,
    fit,
    is_determined,
)
from gsba.localization.localizer import (
    NO_PLACE,
    NOT_DETERMINED,
    NUM_NEAREST,
    LocalizedFrame,
    Localizer,
    typical_sigma,
)
from gsba.localization.photos import (
    Photo,
    as_panorama,
    photo_features,
    photo_rig,
    read_photo,
    shows,
)
from gsba.localization.pictures import QueryPicture
from gsba.localization.pose_search import LOOK_ALIKE, MIN_RATIO, TWO_PLACES, Candidates
from gsba.localization.run_map import Query
from gsba.localization.surroundings import is_contradicted
from gsba.log import GsbaError, track
from gsba.loop_closure.join_evidence import JoinEvidence
from gsba.matching.absolute_pose import (
    MIN_WITNESSES,
    FoundPose,
    are_apart,
    camera_pose,
    is_significant,
)
from gsba.matching.guided_search import searchable
from gsba.types import Features
from gsba.types.records import with_rows

_NUM_PLACES = 10  # keyframes with a face that looks most like a photo
_GATES_RAD = tuple(np.deg2rad([2.5, 1.0, 0.5]))  # around predicted bearings, round by round
_MIN_POINTS = 15  # inliers of a fit
_SAMPLE = 4  # points that determine a pose and a focal length
_FOCALS = (0.1, 20.0)  # least and largest focal length, in longer sides
_ANNEALED = (32.0, *COARSE, *FINE)  # scales of the loss of the first guided fit: a focal length
# that a wall leaves open is far off for what is beside the wall
_CELLS_PER_SIDE = 64  # along 90 degrees: keypoints within one are one witness of a guided fit


@dataclass(frozen=True, slots=True)
class CameraOfPhotos:
    """A camera that photos share."""

    projection: PerspectiveProjection
    covariance: np.ndarray  # (5, 5) float64: log focal length, principal point in focal lengths,
    # two radial terms
    photos: tuple[str, ...]  # names


@dataclass(frozen=True, slots=True)
class LocalizedPhotos:
    """Photos in a run's map, and their cameras."""

    frames: tuple[LocalizedFrame, ...]  # of all photos; the pose is world_T_camera: x right, y
    # down, z forward
    cameras: tuple[CameraOfPhotos, ...]


@dataclass(frozen=True, slots=True)
class _Placed:
    """A photo with a pose and a camera of its own."""

    photo: Photo
    image: np.ndarray  # (H, W, 3) uint8
    world_T_camera: np.ndarray  # (4, 4)
    projection: PerspectiveProjection
    seen: PointSightings  # points that it shows, camera 0
    num_inliers: int
    evidence: JoinEvidence  # for and against its pose


@dataclass(frozen=True, slots=True)
class _Recognised:
    """A photo with a first pose and focal length."""

    world_T_camera: np.ndarray  # (4, 4)
    projection: PerspectiveProjection  # without distortion
    places: np.ndarray  # (N,) keyframes that look most like it
    candidates: Candidates  # that agree with its pose
    pixels: np.ndarray  # (K, 2) of all keypoints
    features: Features  # all keypoints
    cut_by: PerspectiveProjection  # by which the photo was cut into faces for them


def localize_photos(localizer: Localizer, photos: Sequence[Photo]) -> LocalizedPhotos:
    """Poses of photos, each first placed alone, then all fitted together with the cameras that they
    share, to keypoints and to patches aligned below a pixel."""
    placed: list[_Placed] = []
    refused: dict[str, LocalizedFrame] = {}
    for photo in track(photos, "localising photos", len(photos)):
        try:
            found = _place(localizer, photo)
        except GsbaError as error:
            found = str(error)
        if isinstance(found, str):
            refused[photo.name] = LocalizedFrame.refused(photo.name, found)
        else:
            placed.append(found)
    together = _fit_together(localizer, placed) if placed else ([], ())
    frames = refused | {frame.name: frame for frame in together[0]}
    return LocalizedPhotos(tuple(frames[photo.name] for photo in photos), tuple(together[1]))


def _place(localizer: Localizer, photo: Photo) -> _Placed | str:
    """A photo placed by its keypoints; or the reason why it is not."""
    image, reason = photo.load(), NO_PLACE
    known = photo.focal is not None
    half = max(photo.width, photo.height) / 2
    # fields of view of the longer side that are tried where the focal length is not known
    fields = np.deg2rad([70.0, 45.0, 105.0])
    focals = [photo.focal] if photo.focal else [half / np.tan(f / 2) for f in fields]
    best: _Placed | None = None
    for focal in focals:
        projection = photo.projection(focal)
        features = _features(localizer, image, projection)
        start, why = _recognise(localizer, photo, features, projection, known)
        if start is None:
            reason = why or reason
            continue
        found = _refine(localizer, photo, image, start)
        if found is not None and (best is None or found.num_inliers > best.num_inliers):
            best = found
    if best is None:
        return reason
    return LOOK_ALIKE if is_contradicted(best.evidence) else best


def _refine(
    localizer: Localizer, photo: Photo, image: np.ndarray, first: _Recognised
) -> _Placed | None:
    """A recognised photo fitted to all points around it; None if they contradict its pose."""
    start, prior = first.projection, photo.prior_sigmas()
    expected = photo.projection(photo.focal or start.focal)
    stiff = np.concatenate([prior[:1], 0.1 * prior[1:]])  # a first fit is of the focal length
    seen = _sightings(localizer, first.candidates, first.pixels, first.features, first.cut_by)
    belief = CameraPrior(expected.step_from(start), stiff)
    fitted = fit([seen], first.world_T_camera[None], COARSE, [start], [belief])
    features, cut_by = first.features, first.cut_by
    for n, gate in enumerate(_GATES_RAD):
        pose, projection = fitted.world_T_rigs[0], _perspective(fitted.projections[0])
        if not _plausible(projection):
            return None
        if n == len(_GATES_RAD) - 1:  # faces once more, now that the projection is known
            features, cut_by = _features(localizer, image, projection), projection
        pixels = cut_by.project(features.bearings_rig)
        query = _query(localizer, features, projection.unproject(pixels))
        candidates = localizer.candidates_around(query, pose, gate, first.places)
        if len(candidates) < _MIN_POINTS:
            return None
        seen = _sightings(localizer, candidates, pixels, features, cut_by)
        belief = CameraPrior(expected.step_from(projection), prior)
        scales = _ANNEALED if n == 0 else FINE
        fitted = fit([seen], pose[None], scales, [projection], [belief])
    pose, projection = fitted.world_T_rigs[0], _perspective(fitted.projections[0])
    sigma = float(fitted.noises[0]) * typical_sigma(seen.spreads) / projection.focal
    chance = (GATE_SIGMAS * sigma / _GATES_RAD[-1]) ** 2
    given = candidates.bearings, fitted.inliers[0], chance  # no sample of them chose the pose
    if not is_significant(*given, sample=0, per_side=_CELLS_PER_SIDE):
        return None
    evidence = localizer.surroundings.evidence(
        query, pose, localizer.usual.of_camera(-1), lambda points: shows(projection, points)
    )
    inliers = int(fitted.inliers[0].sum())
    return _Placed(photo, image, pose, projection, seen, inliers, evidence)


def _plausible(projection: PerspectiveProjection) -> bool:
    """True if a camera could have this focal length."""
    share = projection.focal / max(projection.width, projection.height)
    return _FOCALS[0] < share < _FOCALS[1]


def _features(
    localizer: Localizer, image: np.ndarray, projection: PerspectiveProjection
) -> Features:
    rig = photo_rig(projection, localizer.map.rig)
    return photo_features(image, projection, rig, localizer.extractor)


def _query(localizer: Localizer, features: Features, bearings: np.ndarray) -> Query:
    """Keypoints of a photo, ready to be matched, in directions (K, 3)."""
    ready = replace(features, bearings_rig=bearings, faces=owner_faces(bearings))
    every = searchable(ready, localizer.map.axes)
    return Query(features, bearings, None, every, every)


def _recognise(
    localizer: Localizer,
    photo: Photo,
    features: Features,
    projection: PerspectiveProjection,
    known: bool,
) -> tuple[_Recognised | None, str]:
    """A first pose and focal length by the places that look most like a photo; or the reason."""
    import pycolmap

    if len(features) < _MIN_POINTS:
        return None, NO_PLACE
    query = _query(localizer, features, features.bearings_rig)
    places = localizer.index.nearest_faces(query.all.descriptors, _NUM_PLACES)
    candidates = localizer.candidates_of(query, places, strongest=False)
    pixels = projection.project(candidates.bearings)
    params = (projection.focal, photo.width / 2, photo.height / 2)
    camera = pycolmap.Camera(
        model="SIMPLE_PINHOLE", width=photo.width, height=photo.height, params=params
    )
    # of inliers: a first pose leaves out the distortion
    max_error, seed = np.deg2rad(0.6) * projection.focal, localizer.map.settings.seed

    def search(rows: np.ndarray, least: int) -> FoundPose | None:
        given = pixels[rows], candidates.points_world[rows], camera, max_error, seed, least
        return camera_pose(*given, MIN_RATIO, estimate_focal=not known)

    found = search(np.ones(len(pixels), bool), MIN_WITNESSES)
    chance = np.pi * max_error**2 / (photo.width * photo.height)
    if found is None or not is_significant(candidates.bearings, found.inliers, chance, _SAMPLE):
        return None, ""
    if not _plausible(photo.projection(found.focal)):
        return None, ""
    # A pose must outweigh the best one at another place by half, of the candidates left over.
    rival = search(~found.inliers, max(MIN_WITNESSES, int(found.inliers.sum() / 1.5)))
    depth = found.depth(candidates.points_world)
    if rival is not None and are_apart(found.world_T_rig, rival.world_T_rig, depth):
        return None, TWO_PLACES
    start = photo.projection(found.focal)
    agreeing = with_rows(candidates, found.inliers)
    every = projection.project(features.bearings_rig)
    return _Recognised(found.world_T_rig, start, places, agreeing, every, features, projection), ""


def _sightings(
    localizer: Localizer,
    candidates: Candidates,
    pixels: np.ndarray,
    features: Features,
    cut_by: PerspectiveProjection,
) -> PointSightings:
    """Candidates as pixels (K, 2) of the photo, with the noise of their keypoints."""
    rows = candidates.keypoints
    by_bearing = cut_by.jacobians(features.bearings_rig[rows])[0]
    spreads = by_bearing @ np.swapaxes(by_bearing, 1, 2)
    spreads *= features.sigmas_rad[rows, None, None] ** 2
    return localizer.map.sightings(candidates.points, pixels[rows], spreads, camera=0)


def _fit_together(
    localizer: Localizer, placed: Sequence[_Placed]
) -> tuple[list[LocalizedFrame], list[CameraOfPhotos]]:
    """Poses and shared cameras of placed photos, by keypoints, then by patches."""
    names = list(dict.fromkeys(one.photo.camera for one in placed))
    numbers = [names.index(one.photo.camera) for one in placed]
    groups = [[one for one in placed if one.photo.camera == name] for name in names]
    leaders = [max(group, key=lambda one: one.num_inliers) for group in groups]
    starts = [leader.projection for leader in leaders]
    expected = [
        leader.photo.projection(leader.photo.focal or leader.projection.focal) for leader in leaders
    ]
    sigmas = [leader.photo.prior_sigmas() for leader in leaders]
    pictures = [replace(one.seen, camera=c) for one, c in zip(placed, numbers, strict=True)]
    poses = np.array([one.world_T_camera for one in placed])

    def solve(seen: Sequence[PointSightings]) -> PoseFit:
        steps = [to.step_from(start) for start, to in zip(starts, expected, strict=True)]
        beliefs = [CameraPrior(*pair) for pair in zip(steps, sigmas, strict=True)]
        return fit(seen, poses, FINE, starts, beliefs)

    fitted = solve(pictures)
    for _ in range(2):
        poses, starts = fitted.world_T_rigs, [_perspective(one) for one in fitted.projections]
        pictures = [
            _on_patches(localizer, one, pose, starts[c], seen)
            for one, pose, c, seen in zip(placed, poses, numbers, pictures, strict=True)
        ]
        fitted = solve(pictures)
    frames = [
        _judged(localizer, one.photo.name, fitted, p, seen, numbers[p])
        for p, (one, seen) in enumerate(zip(placed, pictures, strict=True))
    ]
    cameras = [
        CameraOfPhotos(
            _perspective(fitted.projections[c]),
            fitted.camera_covariances[c][:5, :5],
            tuple(one.photo.name for one in group),
        )
        for c, group in enumerate(groups)
    ]
    return frames, cameras


def _perspective(projection: object) -> PerspectiveProjection:
    assert isinstance(projection, PerspectiveProjection)
    return projection


def _on_patches(
    localizer: Localizer,
    placed: _Placed,
    world_T_camera: np.ndarray,
    projection: PerspectiveProjection,
    before: PointSightings,
) -> PointSightings:
    """Points that patches find in a photo; the sightings before if they are too few."""
    aligner, map_ = localizer.aligner, localizer.map
    grey, mask = as_panorama(placed.image, projection, aligner.width)
    places = localizer.map.nearest(world_T_camera, NUM_NEAREST)
    expected = aligner.expected(world_T_camera, places).shown_by(projection, world_T_camera, map_)
    image = SphereImage.of(grey, smooth=True)
    found = aligner.align(expected, world_T_camera, image, mask, SphereField.none(), ONE_CENTRE)
    if len(found.points) < _MIN_POINTS:
        return before
    pixels = projection.project(found.bearings)
    axes = projection.jacobians(found.bearings)[0] @ np.swapaxes(
        tangent_basis(found.bearings), 1, 2
    )
    spreads = axes @ found.covariances @ np.swapaxes(axes, 1, 2)
    return map_.sightings(found.points, pixels, spreads, camera=before.camera)


def _judged(
    localizer: Localizer, name: str, fitted: PoseFit, number: int, seen: PointSightings, camera: int
) -> LocalizedFrame:
    pose, inliers = fitted.world_T_rigs[number], fitted.inliers[number]
    covariance = fitted.covariances[number]
    determined = is_determined(pose, covariance, seen.points_world[inliers])
    if inliers.sum() < _MIN_POINTS or not determined:
        return LocalizedFrame.refused(name, NOT_DETERMINED)
    focal = _perspective(fitted.projections[camera]).focal
    noise = float(fitted.noises[number]) * typical_sigma(seen.spreads) / focal
    frame = localizer.frame_at(name, pose, covariance, int(inliers.sum()), noise, camera)
    return localizer.with_map_error(frame)


def localize_all(localizer: Localizer, pictures: Sequence[QueryPicture]) -> LocalizedPhotos:
    """Localise panoramas and photos, in the order of the pictures; one that cannot be read is
    refused with the reason. With the cameras of photos."""
    found: dict[str, LocalizedFrame] = {}
    photos: list[Photo] = []
    for picture in track(pictures, "localising", len(pictures)):
        try:
            if picture.frames is not None:
                given = picture.frames, picture.frame, picture.camera
                found[picture.name] = localizer.localize_frame(*given)
                continue
            assert picture.path is not None
            if picture.photo:
                photos.append(read_photo(picture.path))
            else:
                found[picture.name] = localizer.localize(picture.path, picture.name)
        except GsbaError as error:
            found[picture.name] = LocalizedFrame.refused(picture.name, str(error))
    together = localize_photos(localizer, photos)
    found |= {frame.name: frame for frame in together.frames}
    return LocalizedPhotos(tuple(found[picture.name] for picture in pictures), together.cameras)
