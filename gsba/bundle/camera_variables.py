"""The camera's unknowns as variables of the graph: their keys, start values, priors, and the block
of the observations that they act on."""

from dataclasses import dataclass, replace
from functools import partial

import gtsam
import numpy as np

from factors import RobustLoss
from factors.camera_block import CameraBlock, pixels_of, sightings_of
from factors.camera_rows import CameraVariables, half_baseline, lens_sizes, vector
from gsba.bundle import lens_axes, readout, self_calibration
from gsba.bundle.adjustment import AdjustmentContext
from gsba.bundle.pose_variables import X
from gsba.bundle.readout import CameraEstimate
from gsba.camera.fisheye import Rig, rotation_of
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

_LEAST_TURN = 1e-6  # rad, standard deviation


@dataclass(frozen=True, slots=True)
class OwnMotion:
    """Prior on each frame's motion during its readout, beside that of its velocity."""

    values: np.ndarray  # (F, 6) to start from
    sigmas: np.ndarray  # (6,) about zero
    told: np.ndarray  # (F,) bool, frames whose rotation a gyro tells
    told_sigma: float  # rad, about zero, of these

    def sigmas_of(self, frame: int) -> np.ndarray:
        """Standard deviations (6,) of one frame."""
        if not self.told[frame]:
            return self.sigmas
        return np.concatenate([np.full(3, self.told_sigma), self.sigmas[3:]])


@dataclass(frozen=True, slots=True)
class CameraUnknowns:
    """The variables of a camera that was found, at some poses."""

    camera: CameraEstimate  # to start from
    variables: CameraVariables
    values: gtsam.Values  # of the camera alone
    shared: gtsam.NonlinearFactorGraph  # priors on these, but for frames' own motion
    own: OwnMotion | None  # None = frames are taken at one instant
    context: AdjustmentContext

    @classmethod
    def of(
        cls,
        camera: CameraEstimate,
        world_T_rigs: np.ndarray,
        timestamps: np.ndarray,
        context: AdjustmentContext,
    ) -> "CameraUnknowns":
        """Variables of what was taken of a camera: the rest stays as it is.

        Args:
            camera: as found so far.
            world_T_rigs: (F, 4, 4) poses, whose velocities frames have while they are read.
            timestamps: (F,) seconds.
            context: settings, and a gyro's rates.
        """
        lenses, frames = camera.lenses, range(len(world_T_rigs))
        values, graph = gtsam.Values(), gtsam.NonlinearFactorGraph()
        centres = [C(lens) for lens in range(lenses.num_lenses - 1)]
        given: dict = {"poses": [X(f) for f in frames], "centres": centres, "axes": lenses.axes}
        for key, centre in zip(centres, lenses.centres[:-1], strict=True):
            values.insert(key, np.array(centre))
        if lenses.inverse_stitch_radius:
            if context.settings.camera.stitch_radius_m is None:
                given["radius"] = N(0)
                values.insert(N(0), np.array([lenses.inverse_stitch_radius]))
            else:  # metres: in map units it goes with the distance between the lenses
                given["front_by_radius"] = lenses.inverse_stitch_radius * lenses.baseline / 2
        if lenses.fisheyes is not None:
            assert lenses.reference_calibration is not None
            keys = keys_of_lenses(lenses.num_lenses)
            given["lenses"] = keys
            given["calibration"] = _rows(lenses.reference_calibration)
            off = split_lenses(self_calibration.from_calibrated(lenses))
            for key, part, spread in zip(
                keys, off, split_lenses(self_calibration.spread(lenses.num_lenses)), strict=True
            ):
                _add(values, graph, key, part, spread)
        own = None
        if lenses.readout_motion is not None:
            velocities = velocities_of(camera, world_T_rigs, timestamps, context)
            given |= {"readout": D(0), "velocities": velocities}
            given["motions"] = [W(f) for f in frames]
            said = context.settings.camera.readout()
            values.insert(D(0), np.array([camera.readout_s]))
            if said is not None:
                model = gtsam.noiseModel.Isotropic.Sigma(1, said[1])
                graph.add(gtsam.PriorFactorVector(D(0), np.array([said[0]]), model))
            own = _own_motion(camera, velocities, context)
            for f in frames:
                values.insert(W(f), np.array(own.values[f]))
        if lenses.axes is not None:
            given["turns"] = [A(f) for f in frames]
            for f in frames:
                _add(values, graph, A(f), np.zeros(2), np.full(2, lens_axes.TURNS[-1]))
        return cls(camera, CameraVariables(**given), values, graph, own, context)

    @property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """Priors on the camera's variables."""
        graph, own = gtsam.NonlinearFactorGraph(self.shared), self.own
        if own is None:
            return graph
        for f in range(len(own.values)):
            model = gtsam.noiseModel.Diagonal.Sigmas(own.sigmas_of(f))
            graph.add(gtsam.PriorFactorVector(W(f), np.zeros(6), model))
        return graph

    def block(
        self, landmarks: Landmarks, shown: Keypoints, noise: float, curved: bool = False
    ) -> CameraBlock:
        """The observations of some points, to be explained by poses and camera.

        Args:
            landmarks: points and what observes them.
            shown: keypoints as pictures show them.
            noise: of the observations, in units of the keypoints' own sigmas.
            curved: see `CameraBlock`.
        """
        tracks, rows = landmarks.tracks, shown.rows(landmarks.tracks)
        lenses, directions = self.camera.lenses, shown.bearings_rig[rows]
        seeing = lenses.facing(directions, tracks.frames)
        fractions = lenses.fractions(directions, tracks.frames)
        roots = np.eye(2) / shown.sigmas_rad[rows, None, None]
        if shown.sqrt_infos is not None:
            roots = shown.sqrt_infos[rows]
        measured, roots = directions, roots / noise
        calibration = self.variables.calibration
        if calibration is not None:
            measured, by_pixel = pixels_of(directions, seeing, calibration)
            roots = roots @ by_pixel
        given = tracks.frames, tracks.points, tracks.num_points, measured, roots, seeing, fractions
        solver = self.context.settings.solver
        return CameraBlock(
            self.variables,
            sightings_of(*given)[0],
            landmarks.points_world,
            RobustLoss(solver.loss, solver.loss_sigmas),
            self.context.num_threads,
            curved=curved,
        )

    def spread_as(self, sigmas: np.ndarray) -> "CameraUnknowns":
        """The unknowns with other standard deviations (6,) of frames' own motion."""
        assert self.own is not None
        camera = replace(self.camera, own_sigmas=sigmas)
        return replace(self, camera=camera, own=replace(self.own, sigmas=sigmas))

    def estimate(self, values: gtsam.Values) -> CameraEstimate:
        """The camera at values of its variables."""
        found, lenses, variables = self.camera, self.camera.lenses, self.variables
        centres = [vector(values, key) for key in variables.centres]
        lenses = replace(lenses, centre=np.concatenate(centres))
        if variables.radius is not None:
            inverse = max(float(vector(values, N(0))[0]), 0.0)
            lenses = replace(lenses, inverse_stitch_radius=inverse)
        elif variables.front_by_radius:
            half = half_baseline(lenses.num_lenses) @ lenses.centre
            inverse = variables.front_by_radius / float(np.linalg.norm(half))
            lenses = replace(lenses, inverse_stitch_radius=inverse)
        if variables.motions is not None and variables.velocities is not None:
            duration = float(vector(values, D(0))[0])
            beside = np.array([vector(values, key) for key in variables.motions])
            lenses = replace(lenses, readout_motion=duration * variables.velocities + beside)
            sigmas = None if self.own is None else self.own.sigmas
            found = replace(found, readout_s=duration, own_sigmas=sigmas)
        if variables.turns is not None:
            turns = np.array([vector(values, key) for key in variables.turns])
            lenses = lens_axes.turned(lenses, turns)
        if variables.lenses is not None:
            changes = np.concatenate([vector(values, key) for key in variables.lenses])
            plain = replace(lenses, fisheyes=lenses.reference_calibration)
            lenses = self_calibration.moved(plain, changes)
        return replace(found, lenses=lenses)


def velocities_of(
    camera: CameraEstimate,
    world_T_rigs: np.ndarray,
    timestamps: np.ndarray,
    context: AdjustmentContext,
) -> np.ndarray:
    """Velocities (F, 6) of frames, from poses, and from a gyro that is believed."""
    turning = context.turning if camera.by_gyro else None
    return readout.velocities(world_T_rigs, timestamps, turning)


def split_lenses(columns: np.ndarray) -> list[np.ndarray]:
    """Parameters (..., K) of raw lenses, split by variable."""
    sizes = lens_sizes(self_calibration.num_lenses_of(columns.shape[-1]))
    return np.split(columns, np.cumsum(sizes[:-1]), axis=-1)


def keys_of_lenses(num: int) -> list[int]:
    """Keys of the variables of L raw lenses, in the order of `self_calibration`."""
    others = [[F(lens), K(lens), B(lens - 1)] for lens in range(1, num)]
    return [F(0), K(0), *(key for keys in others for key in keys)]


def _own_motion(
    camera: CameraEstimate, velocities: np.ndarray, context: AdjustmentContext
) -> OwnMotion:
    """Frames' own motion, its rotation held to what a gyro that is believed tells."""
    assert camera.lenses.readout_motion is not None
    beside = camera.lenses.readout_motion - camera.readout_s * velocities
    sigmas, turning = readout.own_sigmas(camera, velocities), context.turning
    if turning is None or not camera.by_gyro:
        return OwnMotion(beside, sigmas, np.zeros(len(beside), bool), np.inf)
    sigma = max(camera.readout_s * turning.rate_sigma, _LEAST_TURN)
    return OwnMotion(beside, sigmas, np.all(np.isfinite(turning.rates), axis=1), sigma)


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


def _rows(rig: Rig) -> np.ndarray:
    """Lenses as `factors.camera_rows` has them (L, 16)."""
    return np.array(
        [[lens.focal, *lens.principal, *lens.radial, *rotation_of(lens).ravel()] for lens in rig]
    )
