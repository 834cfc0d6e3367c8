"""Families of residuals: one object adds everything that one source of knowledge contributes:
factors, built anew whenever the map changes, and variables of its own if need be."""

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import gtsam
import numpy as np

from factors import BearingTerm, Block, FaceCameras, ReprojectionTerm, Term
from factors.system_layout import is_hard_constraint
from gsba.bundle.observation_noise import face_roots
from gsba.bundle.pose_variables import X
from gsba.camera.rig import RIG_R_FACE, CubeRig
from gsba.log import GsbaError
from gsba.types import FamilyVariables, Keypoints, Landmarks, Solution


@dataclass(frozen=True, slots=True)
class PointObservations:
    """O observations of points by frames, each with its noise."""

    frames: np.ndarray  # (O,) int64, row of the frame
    points: np.ndarray  # (O,) int64, row of the point
    bearings_rig: np.ndarray  # (O, 3) float64, unit, rig frame
    sigmas_rad: np.ndarray  # (O,) float64, of either angle on `factors.tangent_basis`
    sqrt_infos: np.ndarray | None  # (O, 2, 2) 1/rad on that basis, in place of sigmas_rad where
    # observations are sharper along one direction; None = they are not
    origins_rig: np.ndarray | None  # (O, 3) map units, rig frame, where each ray starts; None = in
    # the rig's centre
    faces: np.ndarray  # (O,) uint8, cube face that shows the observation
    pixels: np.ndarray  # (O, 2) float64, (u, v) on it, corner origin

    @classmethod
    def of(cls, landmarks: Landmarks, keypoints: Keypoints, noise: float) -> "PointObservations":
        """Observations of landmarks; noise: of an observation, in units of its keypoint's own
        sigma."""
        tracks, rows = landmarks.tracks, keypoints.rows(landmarks.tracks)
        infos = keypoints.sqrt_infos
        return cls(
            frames=tracks.frames,
            points=tracks.points,
            bearings_rig=keypoints.bearings_rig.take(rows, axis=0),
            sigmas_rad=noise * keypoints.sigmas_rad[rows],
            sqrt_infos=None if infos is None else infos.take(rows, axis=0) / noise,
            origins_rig=keypoints.origins_of(rows),
            faces=keypoints.faces[rows],
            pixels=keypoints.pixels.take(rows, axis=0),
        )


@dataclass(frozen=True, slots=True)
class MapSnapshot:
    """The map that a family builds its factors from."""

    names: tuple[str, ...]  # (F) of the frames
    timestamps: np.ndarray  # (F,) float64 seconds; 0, 1, 2, ... where frames have no times
    world_T_rigs: np.ndarray  # (F, 4, 4) float64, poses so far, map units
    maps: np.ndarray  # (F,) int64, map of each frame, 0 = the largest: maps have worlds and scales
    # of their own until they are joined
    landmarks: Landmarks  # points so far; none before the first adjustment
    variables: gtsam.Values  # of all families, as the last adjustment left them; empty before it
    gauge_held: bool = False  # another family holds the world and scale of the first frame's map:
    # the trajectory prior does not hold the first pose then


class Family(Protocol):
    """Residuals of one kind, their variables, and their part of the report.

    Subclass it; only `name`, `digest` and one of `graph`, `blocks` and `landmark_terms` are needed.
    Keys of frames are `gsba.X(frame)`; keys of own variables are `gtsam.symbol` with a capital
    letter. An instance is never changed: `fitted` and `for_covariances` return another one.
    """

    name: str  # in settings, in the report and in messages
    digest: str  # of all that the family depends on: results are resumed while it stays the same
    fixes_gauge: bool = False  # its scale or world becomes that of the result
    limits_drift: bool = False  # its residuals bend long paths softly: adjustments start with
    # little damping and converge to a finer tolerance
    observes_points: bool = False  # it gives terms: several families that do share the information
    # of each observation
    reserved_letters: str = ""  # small letters of own keys, which only families of gsba have

    def variables(self, snapshot: MapSnapshot) -> gtsam.Values:
        """Own variables with the values to start from."""
        return gtsam.Values()

    def graph(self, snapshot: MapSnapshot) -> gtsam.NonlinearFactorGraph:
        """Few factors, on frames' poses and own variables of any type."""
        return gtsam.NonlinearFactorGraph()

    def blocks(self, snapshot: MapSnapshot) -> Sequence[Block]:
        """Many residuals held as arrays, see `factors.Block`."""
        return ()

    def landmark_terms(self, observed: PointObservations) -> Sequence[Term]:
        """Residuals of the map's points, which are eliminated: see `observes_points`.

        Adjustments in which lenses, readout or motion of the camera are solved for have bearings
        in their place.
        """
        return ()

    def holds_gauge(self, snapshot: MapSnapshot) -> bool:
        """True if its factors determine world and scale of the first frame's map."""
        return self.fixes_gauge

    def fitted(self, snapshot: MapSnapshot) -> "Family | None":
        """The family for one adjustment, asked for once at its start: all rounds minimise one cost.

        Returns:
            The family, for instance without outliers; None = it contributes nothing to this map.
        """
        return self

    def for_covariances(self, snapshot: MapSnapshot) -> "Family":
        """The family with the factors that covariances are computed from.

        The first pose and the extent of each map are held fixed there, whatever `holds_gauge` says.
        """
        return self

    def report(self, snapshot: MapSnapshot) -> Mapping[str, Any]:
        """The family's part of report.json, under `families.NAME`: JSON values of the final map."""
        return {}


@dataclass(frozen=True, slots=True)
class FamilyTerms:
    """Factors, blocks and variables that families add to an adjustment."""

    graph: gtsam.NonlinearFactorGraph
    blocks: tuple[Block, ...]
    values: gtsam.Values  # own variables to start from

    def variables(self, values: gtsam.Values) -> FamilyVariables | None:
        """Own variables as an adjustment left them; None where there are none."""
        keys = list(self.values.keys())
        return kept(values, keys) if keys else None


def _check_complete(family: Family) -> None:
    """GsbaError where a family lacks a name or digest, or gives residuals that nothing asks for."""
    kind = type(family)
    if Family not in kind.__mro__:
        raise GsbaError(f"families: {family!r} is no object of a subclass of gsba.Family")
    for attribute in ("name", "digest"):
        if not hasattr(family, attribute):
            raise GsbaError(f"family {kind.__name__} has no {attribute}: give it one, a text")
    gives = {
        method
        for method in ("graph", "blocks", "landmark_terms", "fitted")
        if getattr(kind, method) is not getattr(Family, method)
    }
    if not gives:
        raise GsbaError(
            f"family {family.name} has no residuals: define graph, blocks or landmark_terms"
        )
    if "landmark_terms" in gives and not family.observes_points:
        raise GsbaError(
            f"family {family.name}: its landmark_terms count only with observes_points = True"
        )


@dataclass(frozen=True, slots=True)
class Families:
    """The families of a run, and the frames of their snapshots. GsbaError: two have one name, or
    one has no name, no digest or no residuals."""

    members: tuple[Family, ...] = ()
    names: tuple[str, ...] = ()  # (F) of the frames
    timestamps: np.ndarray = field(default_factory=lambda: np.zeros(0))  # (F,) float64 seconds

    def __post_init__(self) -> None:
        for family in self.members:
            _check_complete(family)
        names = [family.name for family in self.members]
        for name in {name for name in names if names.count(name) > 1}:
            raise GsbaError(f"two families are named {name}: give each a name of its own")

    def with_members(self, members: Iterable[Family]) -> "Families":
        """Other families of the same frames."""
        return replace(self, members=tuple(members))

    @property
    def fixing_gauge(self) -> "Families":
        """The families whose scale or world becomes that of the result."""
        return self.with_members(family for family in self.members if family.fixes_gauge)

    @property
    def observing_points(self) -> "Families":
        """The families whose residuals are of the map's points."""
        return self.with_members(family for family in self.members if family.observes_points)

    def landmark_terms(
        self, landmarks: Landmarks, keypoints: Keypoints, noise: float
    ) -> list[Term]:
        """Residuals of points by all families that observe them; noise: of the observations, in
        units of the keypoints' own sigmas."""
        observing = self.observing_points.members
        share = noise * np.sqrt(len(observing))
        observed = PointObservations.of(landmarks, keypoints, share)
        return [term for family in observing for term in family.landmark_terms(observed)]

    def digests(self) -> list[tuple[str, str]]:
        """Names and digests of the families, on which results rest."""
        return [(family.name, family.digest) for family in self.members]

    def snapshot(self, solved: Solution, maps: np.ndarray | None = None) -> MapSnapshot:
        """The snapshot of a solution that families build their factors from; maps: (F,) map of each
        frame, None = there is one."""
        of_frames = numbered(maps, len(solved.world_T_rigs))
        variables = restored(solved.variables)
        given = self.names, self.timestamps, solved.world_T_rigs, of_frames
        return MapSnapshot(*given, solved.landmarks, variables)

    def fitted(self, solved: Solution, maps: np.ndarray | None = None) -> "Families":
        """The families for one adjustment that starts from a solution: see `Family.fitted`."""
        snapshot = self.snapshot(solved, maps)
        fitted = (family.fitted(snapshot) for family in self.members)
        return self.with_members(family for family in fitted if family is not None)

    def terms(self, solved: Solution, maps: np.ndarray | None = None) -> FamilyTerms:
        """Factors, blocks and variables of all families, for an adjustment from a solution; maps:
        (F,) map of each frame, None = there is one.

        Raises:
            GsbaError: a factor on a variable that has no value, or a variable that two families
            have, or whose key is not a family's; a hard constraint, or no graph.
        """
        snapshot = self.snapshot(solved, maps)
        held = any(family.holds_gauge(snapshot) for family in self.members)
        return _terms_of(self.members, replace(snapshot, gauge_held=held))

    def covariance_terms(self, solved: Solution, maps: np.ndarray | None = None) -> FamilyTerms:
        """Terms for covariances: the trajectory prior holds the first pose. See `terms`."""
        snapshot = self.snapshot(solved, maps)
        return _terms_of([family.for_covariances(snapshot) for family in self.members], snapshot)


def _terms_of(families: Sequence[Family], snapshot: MapSnapshot) -> FamilyTerms:
    """Factors, blocks and variables of families; see `Families.terms`."""
    graph, blocks, values = gtsam.NonlinearFactorGraph(), list[Block](), gtsam.Values()
    poses = {X(f) for f in range(len(snapshot.world_T_rigs))}
    for family in families:
        own = family.variables(snapshot)
        for key in own.keys():  # noqa: SIM118
            shown = gtsam.DefaultKeyFormatter(key)
            letter = chr(gtsam.symbolChr(key))
            if not (letter.isupper() or letter in family.reserved_letters):
                raise GsbaError(
                    f"family {family.name}: variable {shown}: make its key by gtsam.symbol with a "
                    "capital letter, others are gsba's own"
                )
            if values.exists(key):
                raise GsbaError(
                    f"family {family.name}: variable {shown} belongs to another family: choose "
                    "another letter"
                )
        known = poses | set(own.keys())
        factors, arrays = family.graph(snapshot), tuple(family.blocks(snapshot))
        if not isinstance(factors, gtsam.NonlinearFactorGraph):
            raise GsbaError(
                f"family {family.name}: graph() returns {type(factors).__name__}, not a "
                "gtsam.NonlinearFactorGraph"
            )
        for n in range(factors.size()):
            _check_known(family, f"factor {n}", factors.at(n).keys(), known)
            if is_hard_constraint(factors.at(n)):
                raise GsbaError(
                    f"family {family.name}: factor {n} is a hard constraint "
                    "(noiseModel.Constrained): give it a small sigma such as 1e-6"
                )
        for block in arrays:
            _check_known(family, "a block", block.keys, known)
        values.insert(own)
        graph.push_back(factors)
        blocks += arrays
    return FamilyTerms(graph, tuple(blocks), values)


def digest_of(*parts: object) -> str:
    """Digest of arrays and of the text of other values, for a family that depends on them."""
    found = hashlib.sha256()
    for part in parts:
        is_array = isinstance(part, np.ndarray)
        found.update(f"{part.dtype}{part.shape}".encode() if is_array else repr(part).encode())
        found.update(np.ascontiguousarray(part).tobytes() if is_array else b"")
    return found.hexdigest()[:16]


def numbered(maps: np.ndarray | None, num_frames: int) -> np.ndarray:
    """Map (F,) int64 of each frame, or its recording; None = there is one, number 0."""
    return np.zeros(num_frames, np.int64) if maps is None else np.asarray(maps, np.int64)


def _check_known(family: Family, what: str, keys: Iterable[int], known: set[int]) -> None:
    """GsbaError where a residual is about a variable that has no value."""
    for key in keys:
        if key not in known:
            raise GsbaError(
                f"family {family.name}: {what} is about variable "
                f"{gtsam.DefaultKeyFormatter(key)}, which has no value: there is no such frame, "
                "and variables() does not return it"
            )


_READERS: dict[str, Callable[[gtsam.Values, int], Any]] = {  # RuntimeError for another type
    "double": gtsam.Values.atDouble,
    "Point2": gtsam.Values.atPoint2,
    "Point3": gtsam.Values.atPoint3,
    "Vector": gtsam.Values.atVector,
    "Rot3": gtsam.Values.atRot3,
    "Pose3": gtsam.Values.atPose3,
    "Unit3": gtsam.Values.atUnit3,
    "Similarity3": gtsam.Values.atSimilarity3,
    "ConstantBias": gtsam.Values.atConstantBias,
}


def _numbers(value: Any) -> np.ndarray:
    """A value as an array: a matrix row by row where it is one, a similarity's scale last."""
    if isinstance(value, gtsam.Unit3):
        return np.ravel(value.point3())
    if isinstance(value, gtsam.imuBias.ConstantBias):
        return np.ravel(value.vector())
    if isinstance(value, gtsam.Similarity3):
        rigid = gtsam.Pose3(value.rotation(), value.translation())
        return np.append(rigid.matrix().ravel(), value.scale())
    if isinstance(value, (gtsam.Rot3, gtsam.Pose3)):
        return value.matrix().ravel()
    return np.ravel(np.asarray(value, np.float64))


def _value(kind: str, numbers: np.ndarray) -> Any:
    """The inverse of `_numbers`."""
    if kind == "double":
        return float(numbers[0])
    if kind == "Rot3":
        return gtsam.Rot3(numbers.reshape(3, 3))
    if kind == "Pose3":
        return gtsam.Pose3(numbers.reshape(4, 4))
    if kind == "Unit3":
        return gtsam.Unit3(numbers)
    if kind == "Similarity3":
        rigid = gtsam.Pose3(numbers[:16].reshape(4, 4))
        return gtsam.Similarity3(rigid.rotation(), rigid.translation(), float(numbers[16]))
    if kind == "ConstantBias":
        return gtsam.imuBias.ConstantBias(numbers[:3], numbers[3:])
    return numbers


def kept(values: gtsam.Values, keys: Sequence[int]) -> FamilyVariables:
    """Variables as arrays. GsbaError: a variable of a type that is not among those above."""
    kinds, numbers = list[str](), list[np.ndarray]()
    for key in keys:
        for kind, read in _READERS.items():
            try:
                value = read(values, key)
            except RuntimeError:
                continue
            kinds.append(kind)
            numbers.append(_numbers(value))
            break
        else:
            raise GsbaError(
                f"variable {gtsam.DefaultKeyFormatter(key)} is of a type that runs cannot store; "
                f"use {', '.join(_READERS)}"
            )
    counts = np.array([len(part) for part in numbers], np.int64)
    data = np.concatenate([np.zeros(0), *numbers])
    return FamilyVariables(np.array(keys, np.int64), tuple(kinds), counts, data)


def restored(variables: FamilyVariables | None) -> gtsam.Values:
    """The variables that arrays hold; None = there are none."""
    values = gtsam.Values()
    if variables is None:
        return values
    ends = np.cumsum(variables.counts)
    for key, kind, count, end in zip(
        variables.keys.tolist(), variables.kinds, variables.counts, ends, strict=True
    ):
        values.insert(key, _value(kind, variables.data[end - count : end]))
    return values


class Bearings(Family):
    """Directions to the map's points on the sphere: no seam, no pole, no face. See
    `factors.bearing`."""

    name = "bearing"
    digest = ""
    observes_points = True

    def landmark_terms(self, observed: PointObservations) -> Sequence[Term]:
        """One bearing an observation, as noisy as on its face: a circle of pixels is an ellipse on
        the sphere."""
        roots = observed.sqrt_infos
        if roots is None:
            roots = np.empty((len(observed.faces), 2, 2))
            axes = np.ascontiguousarray(RIG_R_FACE[:, :, 2])
            face_roots(observed.bearings_rig, axes, observed.faces, observed.sigmas_rad, roots)
        return [
            BearingTerm(
                observed.frames,
                observed.points,
                observed.bearings_rig,
                observed.sigmas_rad,
                roots,
                origins_rig=observed.origins_rig,
            )
        ]


@dataclass(frozen=True, slots=True)
class Reprojections(Family):
    """Pixels of the map's points on the faces that show them. See `factors.reprojection`."""

    name = "reprojection"
    digest = ""
    observes_points = True

    rig: CubeRig  # the faces

    def landmark_terms(self, observed: PointObservations) -> Sequence[Term]:
        """One pixel an observation, as noisy as the angle that it subtends."""
        rig, bearings, faces = self.rig, observed.bearings_rig, observed.faces
        cosines = np.einsum("oi,oi->o", bearings, RIG_R_FACE[faces, :, 2])
        num, pixels = len(RIG_R_FACE), observed.pixels
        if observed.origins_rig is not None:  # rays of lenses start elsewhere than faces show them
            pixels = rig.project(bearings, faces)
        cameras = FaceCameras(RIG_R_FACE, np.full(num, rig.focal), np.full((num, 2), rig.principal))
        return [
            ReprojectionTerm(
                observed.frames,
                observed.points,
                pixels,
                faces,
                cameras,
                observed.sigmas_rad * rig.focal / cosines**1.5,
                origins_rig=observed.origins_rig,
            )
        ]
