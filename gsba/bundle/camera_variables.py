"""The camera's unknowns as variables of the graph: their keys, start values, priors, and the block
of the observations that they act on."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import gtsam
import numpy as np

from factors.camera_block import CameraBlock, sightings_of
from factors.camera_rows import CameraVariables, LensVariables, half_baseline, lens_sizes, vector
from gsba.bundle import lens_axes, readout, self_calibration
from gsba.bundle.adjustment import AdjustmentContext
from gsba.bundle.pose_variables import X
from gsba.bundle.readout import CameraEstimate, CameraEstimates
from gsba.camera.fisheye import by_move, project, rotation_of
from gsba.config import CameraSettings
from gsba.types import Keypoints, Landmarks

# Small letters: capital ones are of poses and of families that others add.
A = partial(gtsam.symbol, "a")  # turn (2,) rad of a frame's lenses, about their x and y
B = partial(gtsam.symbol, "b")  # turn (3,) rad of a raw lens but the front one in the rig
C = partial(gtsam.symbol, "c")  # a lens's centre (3,), but the last one's, lenses' frame, map units
D = partial(gtsam.symbol, "d")  # duration (1,) of the readout, s
F = partial(gtsam.symbol, "f")  # relative focal length and principal point (3,) of a lens
K = partial(gtsam.symbol, "k")  # radial terms (4,) of a lens
N = partial(gtsam.symbol, "n")  # inverse of the stitching radius (1,), 1 / map units
W = partial(gtsam.symbol, "w")  # own motion (6,) of a frame, beside that of its velocity


@dataclass(frozen=True, slots=True)
class OwnMotion:
    """Prior on each frame's motion during its readout, beside that of its velocity."""

    values: np.ndarray  # (F, 6) to start from
    sigmas: tuple[np.ndarray, ...]  # (C) of (6,), about zero, of each camera's frames
    told: np.ndarray  # (F,) bool, frames whose rotation a gyro tells
    told_sigmas: tuple[float, ...]  # (C,) rad, about zero, of these
    cameras: np.ndarray  # (F,) int64, camera of each frame

    def sigmas_of(self, frame: int) -> np.ndarray:
        """Standard deviations (6,) of one frame."""
        camera = self.cameras[frame]
        if not self.told[frame]:
            return self.sigmas[camera]
        return np.concatenate([np.full(3, self.told_sigmas[camera]), self.sigmas[camera][3:]])


@dataclass(frozen=True, slots=True)
class CameraUnknowns:
    """The variables of cameras that were found, at some poses."""

    cameras: CameraEstimates  # to start from
    variables: CameraVariables
    values: gtsam.Values  # of the cameras alone
    shared: gtsam.NonlinearFactorGraph  # priors on these, but for frames' own motion
    own: OwnMotion | None  # None = frames are taken at one instant
    context: AdjustmentContext

    @classmethod
    def of(
        cls,
        cameras: CameraEstimates,
        world_T_rigs: np.ndarray,
        timestamps: np.ndarray,
        context: AdjustmentContext,
    ) -> "CameraUnknowns":
        """Variables of what was taken of cameras so far: the rest stays as it is. Frames have the
        velocities of their poses (F, 4, 4) at timestamps (F,), seconds, while they are read."""
        num, parts, first = len(world_T_rigs), list[LensVariables](), 0
        values, graph = gtsam.Values(), gtsam.NonlinearFactorGraph()
        for number, camera in enumerate(cameras.each):
            own = context.of_camera(number).settings.camera
            parts.append(_lens_variables(camera, own, (number, first), values, graph))
            first += parts[-1].num_lenses
        given: dict = {"poses": [X(f) for f in range(num)], "cameras": parts}
        if cameras.of_frame:
            given["of_frame"] = np.array(cameras.of_frame)
        motion = None
        if any(camera.lenses.readout_motion is not None for camera in cameras.each):
            velocities = _velocities(cameras, world_T_rigs, timestamps, context)
            given |= {"velocities": velocities, "motions": [W(f) for f in range(num)]}
            motion = _own_motion(cameras, velocities, context)
            for f in range(num):
                values.insert(W(f), np.array(motion.values[f]))
        if any(part.turning for part in parts):
            given |= {"turns": [A(f) for f in range(num)], "axes": _axes(cameras, num)}
            for f in range(num):
                _add(values, graph, A(f), np.zeros(2), np.full(2, lens_axes.TURNS[-1]))
        return cls(cameras, CameraVariables(**given), values, graph, motion, context)

    @property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """Priors on the cameras' variables."""
        # Frames are often taken at about the pace of steps, and successive ones then move alike;
        # held as if each moved by chance, they bend the radial profile of the lenses instead.
        return self.priors(moves_alike=3.0)

    def priors(self, moves_alike: float = 1.0) -> gtsam.NonlinearFactorGraph:
        """As `graph`; own translations have this times their spread where lenses are solved for."""
        graph, own = gtsam.NonlinearFactorGraph(self.shared), self.own
        if own is None:
            return graph
        solved_for = [camera.lenses is not None for camera in self.variables.cameras]
        for f in range(len(own.values)):
            widened = moves_alike if solved_for[own.cameras[f]] else 1.0
            sigmas = own.sigmas_of(f) * np.repeat([1.0, widened], 3)
            model = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
            graph.add(gtsam.PriorFactorVector(W(f), np.zeros(6), model))
        return graph

    def block(
        self, landmarks: Landmarks, shown: Keypoints, noise: float, curved: bool = False
    ) -> CameraBlock:
        """The observations of some points, to be explained by poses and cameras: keypoints as
        pictures show them, their noise in units of their own sigmas; curved: see `CameraBlock`."""
        tracks, rows = landmarks.tracks, shown.rows(landmarks.tracks)
        seen = shown.bearings_rig[rows], tracks.frames, shown.roots(rows) / noise
        measured, roots, seeing, fractions = self._sighted(*seen)
        given = tracks.frames, tracks.points, tracks.num_points, measured, roots, seeing, fractions
        return CameraBlock(
            self.variables,
            sightings_of(*given)[0],
            landmarks.points_world,
            self.context.solver.loss,
            self.context.num_threads,
            curved=curved,
        )

    def _sighted(
        self, directions: np.ndarray, frames: np.ndarray, roots: np.ndarray
    ) -> tuple[np.ndarray, ...]:
        """Measurements (O, 3), whiteners (O, 2, 2), lenses and readout fractions (O,)."""
        if not self.cameras.of_frame:
            return self._sighted_by(0, directions, frames, roots)
        measured, whiteners = np.empty_like(directions), np.empty_like(roots)
        seeing, fractions = np.empty(len(frames), np.int64), np.empty(len(frames))
        cameras = np.array(self.cameras.of_frame)[frames]
        for number in range(len(self.cameras.each)):
            rows = np.flatnonzero(cameras == number)
            found = self._sighted_by(number, directions[rows], frames[rows], roots[rows])
            measured[rows], whiteners[rows], seeing[rows], fractions[rows] = found
        return measured, whiteners, seeing, fractions

    def _sighted_by(
        self, number: int, directions: np.ndarray, frames: np.ndarray, roots: np.ndarray
    ) -> tuple[np.ndarray, ...]:
        """As `_sighted`, of frames of one camera."""
        lenses, variables = self.cameras.each[number].lenses, self.variables.cameras[number]
        first = int(self.variables.first_lenses[number])
        if variables.num_lenses == 1:
            return directions, roots, np.full(len(frames), first), np.zeros(len(frames))
        seeing = lenses.facing(directions, frames)
        fractions = lenses.fractions(directions, frames)
        if lenses.fisheyes is None:
            return directions, roots, first + seeing, fractions
        measured, whiteners = np.zeros_like(directions), np.empty_like(roots)
        for lens, fisheye in enumerate(lenses.reference_calibration or ()):
            rows = seeing == lens
            measured[rows, :2] = project(fisheye, directions[rows])
            whiteners[rows] = roots[rows] @ np.linalg.inv(by_move(fisheye, directions[rows]))
        return measured, whiteners, first + seeing, fractions

    def spread_as(self, sigmas: Sequence[np.ndarray]) -> "CameraUnknowns":
        """The unknowns with other standard deviations (C) of (6,) of frames' own motion."""
        assert self.own is not None
        pairs = zip(self.cameras.each, sigmas, strict=True)
        each = [
            one if one.lenses.readout_motion is None else replace(one, own_sigmas=own)
            for one, own in pairs
        ]
        own = replace(self.own, sigmas=tuple(sigmas))
        return replace(self, cameras=self.cameras.with_each(each), own=own)

    def estimate(self, values: gtsam.Values) -> CameraEstimates:
        """The cameras at values of their variables."""
        each = zip(self.cameras.each, self.variables.cameras, strict=True)
        return self.cameras.with_each(
            [self._estimate(number, *one, values) for number, one in enumerate(each)]
        )

    def _estimate(
        self, number: int, found: CameraEstimate, variables: LensVariables, values: gtsam.Values
    ) -> CameraEstimate:
        lenses = found.lenses
        if variables.num_lenses == 1:
            return found
        centres = [vector(values, key) for key in variables.centres]
        lenses = replace(lenses, centre=np.concatenate(centres))
        if variables.radius is not None:
            inverse = max(float(vector(values, variables.radius)[0]), 0.0)
            lenses = replace(lenses, inverse_stitch_radius=inverse)
        elif variables.front_by_radius:
            half = half_baseline(lenses.num_lenses) @ lenses.centre
            inverse = variables.front_by_radius / float(np.linalg.norm(half))
            lenses = replace(lenses, inverse_stitch_radius=inverse)
        motions, velocities = self.variables.motions, self.variables.velocities
        if variables.readout is not None and motions is not None and velocities is not None:
            duration = float(vector(values, variables.readout)[0])
            beside = np.array([vector(values, key) for key in motions])
            lenses = replace(lenses, readout_motion=duration * velocities + beside)
            sigmas = None if self.own is None else self.own.sigmas[number]
            found = replace(found, readout_s=duration, own_sigmas=sigmas)
        if variables.turning and self.variables.turns is not None:
            turns = np.array([vector(values, key) for key in self.variables.turns])
            lenses = lens_axes.turned(lenses, turns)
        if variables.lenses is not None:
            changes = np.concatenate([vector(values, key) for key in variables.lenses])
            plain = replace(lenses, fisheyes=lenses.reference_calibration)
            lenses = self_calibration.moved(plain, changes)
        return replace(found, lenses=lenses)


def _lens_variables(
    camera: CameraEstimate,
    settings: CameraSettings,
    numbers: tuple[int, int],
    values: gtsam.Values,
    graph: gtsam.NonlinearFactorGraph,
) -> LensVariables:
    """Variables shared by all frames of a camera; `numbers`: of it and of its first lens."""
    lenses, (number, first) = camera.lenses, numbers
    if not lenses:
        return LensVariables()
    centres = [C(first + lens) for lens in range(lenses.num_lenses - 1)]
    given: dict = {"centres": centres, "turning": lenses.axes is not None}
    for key, centre in zip(centres, lenses.centres[:-1], strict=True):
        values.insert(key, np.array(centre))
    if lenses.inverse_stitch_radius:
        if settings.stitch_radius_m is None:
            given["radius"] = N(number)
            values.insert(N(number), np.array([lenses.inverse_stitch_radius]))
        else:  # metres: in map units it goes with the distance between the lenses
            given["front_by_radius"] = lenses.inverse_stitch_radius * lenses.baseline / 2
    if lenses.fisheyes is not None:
        assert lenses.reference_calibration is not None
        keys = [F(first), K(first)]
        for lens in range(first + 1, first + lenses.num_lenses):
            keys += [F(lens), K(lens), B(lens - 1)]
        given["lenses"] = keys
        given["calibration"] = np.array(
            [
                [lens.focal, *lens.principal, *lens.radial, *rotation_of(lens).ravel()]
                for lens in lenses.reference_calibration
            ]
        )
        off = split_lenses(self_calibration.from_calibrated(lenses))
        for key, part, spread in zip(
            keys, off, split_lenses(self_calibration.spread(lenses.num_lenses)), strict=True
        ):
            _add(values, graph, key, part, spread)
    if lenses.readout_motion is not None:
        given["readout"] = D(number)
        said = settings.readout() or (readout.LIKELY if camera.of_few_frames else None)
        values.insert(D(number), np.array([camera.readout_s]))
        if said is not None:
            model = gtsam.noiseModel.Isotropic.Sigma(1, said[1])
            graph.add(gtsam.PriorFactorVector(D(number), np.array([said[0]]), model))
    return LensVariables(**given)


def _velocities(
    cameras: CameraEstimates,
    world_T_rigs: np.ndarray,
    timestamps: np.ndarray,
    context: AdjustmentContext,
) -> np.ndarray:
    """Velocities (F, 6) of frames that are read row by row, 0 of others."""
    num = len(world_T_rigs)
    whole = np.zeros((num, 6))
    for number, camera in enumerate(cameras.each):
        if camera.lenses.readout_motion is not None:
            rows = cameras.frames_of(number, num)
            turning = context.turning if camera.by_gyro else None
            found = readout.velocities(world_T_rigs, timestamps, turning, context.maps)
            whole[rows] = found[rows]
    return whole


def _axes(cameras: CameraEstimates, num_frames: int) -> np.ndarray:
    """Axes (F, 3, 3) of each frame's lenses."""
    whole = np.tile(np.eye(3), (num_frames, 1, 1))
    for number, camera in enumerate(cameras.each):
        if camera.lenses.axes is not None:
            rows = cameras.frames_of(number, num_frames)
            whole[rows] = camera.lenses.axes[rows]
    return whole


def split_lenses(columns: np.ndarray) -> list[np.ndarray]:
    """Parameters (..., K) of raw lenses, split by variable."""
    sizes = lens_sizes(self_calibration.num_lenses_of(columns.shape[-1]))
    return np.split(columns, np.cumsum(sizes[:-1]), axis=-1)


def _own_motion(
    cameras: CameraEstimates, velocities: np.ndarray, context: AdjustmentContext
) -> OwnMotion:
    """Frames' own motion, its rotation held to what a gyro that is believed tells."""
    num, turning = len(velocities), context.turning
    beside, told, of_frame = np.zeros((num, 6)), np.zeros(num, bool), np.zeros(num, np.int64)
    sigmas, told_sigmas = list[np.ndarray](), list[float]()
    for number, camera in enumerate(cameras.each):
        rows, sigma = cameras.frames_of(number, num), np.inf
        of_frame[rows] = number
        if camera.lenses.readout_motion is None:
            sigmas.append(np.ones(6))  # nothing acts on these: they stay at zero
            told_sigmas.append(sigma)
            continue
        own = camera.lenses.readout_motion - camera.readout_s * velocities
        beside[rows] = own[rows]
        sigmas.append(readout.own_sigmas(camera, velocities[rows]))
        if turning is not None and camera.by_gyro:
            sigma = max(camera.readout_s * turning.rate_sigma, 1e-6)  # rad, standard deviation
            told[rows] = np.all(np.isfinite(turning.rates), axis=1)[rows]
        told_sigmas.append(sigma)
    return OwnMotion(beside, tuple(sigmas), told, tuple(told_sigmas), of_frame)


def _add(
    values: gtsam.Values,
    graph: gtsam.NonlinearFactorGraph,
    key: int,
    value: np.ndarray,
    sigmas: np.ndarray,
) -> None:
    """A variable that is believed to be near zero."""
    values.insert(key, np.array(value))
    model = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    graph.add(gtsam.PriorFactorVector(key, np.zeros(len(value)), model))
