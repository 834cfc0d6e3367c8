"""Two lenses back to back, read row by row: which one saw a bearing, from where, and when.

A 360-degree camera has two fisheyes whose centres are some centimetres apart. A panorama stitched
at infinity shows each direction as the lens that faces it saw it: a ray that starts at that lens.
A panorama stitched for a radius puts things at that distance from the camera's middle where the
middle would see them: the ray goes from the lens to that place.
Rows of each fisheye are read one after another, while the camera moves: a ray belongs to the pose
of its row, which a twist over the readout time carries to the pose of the frame's middle.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from gsba.camera.fisheye import Pair, pixels_of, recalibrated, rotation_of
from gsba.geometry import pose
from gsba.types import Keypoints, Tracks

_HALF_FOV_RAD = np.deg2rad(100.0)  # half field of view of a fisheye that fills its sensor, first to
# last row
_NUM_ROW_TIME_PASSES = 4  # fixed-point passes between a point's pixel and its row's time


def _centre() -> np.ndarray:
    return np.zeros(3)


@dataclass(frozen=True, slots=True)
class Lenses:
    """The camera of a sequence. One centre, one instant by default.

    The lenses' frame has its origin in the rig's centre, and z along the front lens's axis.
    """

    centre: np.ndarray = field(default_factory=_centre)  # (3,) float64, of the front lens in the
    # lenses' frame, map units; the back lens is opposite
    inverse_stitch_radius: float = 0.0  # 1 / map units; 0 = panoramas are stitched at infinity
    band_rad: float = 0.0  # half width of the seam's band in which both lenses are blended
    row_directions: np.ndarray | None = None  # (2, 3) float64, unit, lenses' frame: direction in
    # which the front and the back lens read their rows; None = global shutter
    readout_motion: np.ndarray | None = None  # (F, 6) float64, motion of each frame from its first
    # to its last row, [rotation rad, translation map units], rig frame; None = none
    axes: np.ndarray | None = None  # (F, 3, 3) float64, rig_R_lenses of each frame, where a
    # stabiliser rotated the panorama against them; None = the rig's axes
    reference_calibration: Pair | None = None  # by which panoramas of raw pairs were cut; None =
    # the frames are panoramas
    fisheyes: Pair | None = None  # lenses of raw pairs as estimated; None = reference_calibration

    def __bool__(self) -> bool:
        return bool(self.centre.any()) or self.fisheyes is not None

    @property
    def parts(self) -> tuple[bool, ...]:
        """Which parts were taken: a readout, axes of frames' own, raw lenses of their own."""
        return tuple(part is not None for part in (self.readout_motion, self.axes, self.fisheyes))

    def own(self, directions: np.ndarray, frames: np.ndarray) -> np.ndarray:
        """Directions (N, 3) in the rig frames of frames (N,), rotated into the lenses' frame."""
        if self.axes is None:
            return directions
        return np.einsum("nji,nj->ni", self.axes[frames], directions)

    def origins(
        self, directions: np.ndarray, frames: np.ndarray, signs: np.ndarray | None = None
    ) -> np.ndarray:
        """Centres (N, 3) of the lenses that face directions (N, 3), both in the rig frame.

        Args:
            signs: (N,) of the lenses to take instead, 1 = front, -1 = back.
        """
        signs = facing(self.own(directions, frames)) if signs is None else signs
        if self.axes is None:
            return signs[:, None] * self.centre
        return signs[:, None] * (self.axes[frames] @ self.centre)

    def by_centre(
        self, by_origin: np.ndarray, directions: np.ndarray, frames: np.ndarray
    ) -> np.ndarray:
        """Jacobians (N, D, 3) by the lens centre, from those by the rays' origins in the rig
        frames."""
        signs = facing(self.own(directions, frames))[:, None, None]
        return signs * (by_origin if self.axes is None else by_origin @ self.axes[frames])

    def fractions(
        self,
        directions: np.ndarray,
        frames: np.ndarray,
        row_directions: np.ndarray | None = None,
        signs: np.ndarray | None = None,
    ) -> np.ndarray:
        """Time at which frames (N,) read unit directions (N, 3), in readout times, (N,); 0 = the
        middle.

        Raw pairs have known rows. Otherwise a lens is assumed to be equidistant; the estimated
        motion absorbs the deviation. The lens is the one that faces a direction, or that of `signs`
        as in `origins`.
        """
        row_directions = self.row_directions if row_directions is None else row_directions
        if row_directions is None:
            return np.zeros(len(directions))
        if self.reference_calibration is not None:
            behind = None if signs is None else signs < 0
            lens, pixels = pixels_of(self.reference_calibration, directions, behind)
            heights = np.array([one.height for one in self.reference_calibration])[lens]
            down = rows_run(self.reference_calibration)
            return np.sign(np.sum(down * row_directions, axis=1))[lens] * (
                pixels[:, 1] / heights - 0.5
            )
        own = self.own(directions, frames)
        across = own[:, :2]
        radii = np.linalg.norm(across, axis=1)
        signs = facing(own) if signs is None else signs
        angles = np.arctan2(radii, signs * own[:, 2])
        lens = (signs < 0).astype(int)
        along = np.einsum("ni,ni->n", across, np.asarray(row_directions)[lens, :2])
        return angles / (2 * _HALF_FOV_RAD) * along / np.maximum(radii, 1e-12)

    def rows_down(self) -> np.ndarray:
        """1 (2,) for the front and the back picture of a raw pair that is read from its top row
        down, -1 for one that is read from its bottom row up."""
        assert self.reference_calibration is not None and self.row_directions is not None
        return np.sign(np.sum(rows_run(self.reference_calibration) * self.row_directions, axis=1))

    def swept(self, frame: int) -> np.ndarray:
        """Poses (2, 2, 4, 4) of the rig when the front and the back lens of a raw pair read their
        top and bottom edge, relative to the rig in the middle of the readout."""
        assert (
            self.reference_calibration is not None
            and self.readout_motion is not None
            and self.row_directions is not None
        )
        moved = np.multiply.outer(
            np.outer(self.rows_down(), [-0.5, 0.5]), self.readout_motion[frame]
        )
        turns = _rotations(moved[..., :3].reshape(4, 3)).reshape(2, 2, 3, 3)
        return pose(turns, moved[..., 3:])

    def rays(self, directions: np.ndarray, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Directions and origins (N, 3) of the rays that frames (N,) show in directions (N, 3), rig
        frame in the middle of the readout."""
        origins, seen = self.origins(directions, frames), self.calibrated(directions)
        if self.inverse_stitch_radius:
            seen = directions - self.inverse_stitch_radius * origins
            seen /= np.linalg.norm(seen, axis=1, keepdims=True)
        if self.readout_motion is None:
            return seen, origins
        turns, moves = self._readout_motion_at(directions, frames)
        turned = np.einsum("nij,nj->ni", turns, seen)
        return turned, np.einsum("nij,nj->ni", turns, origins) + moves

    def views(self, directions: np.ndarray, frames: np.ndarray) -> np.ndarray:
        """Transforms (N, 4, 4), rig_T_view, of local views of frames (N,) around unit directions
        (N, 3).

        A view shows the scene in the picture's directions, from the rays' origins. The
        magnification by a finite stitching radius is left out.
        """
        bent, starts = replace(self, readout_motion=None).rays(directions, frames)
        axes = np.cross(directions, bent)
        sines = np.linalg.norm(axes, axis=1, keepdims=True)
        turns = _rotations(axes * (np.arcsin(np.minimum(sines, 1)) / np.maximum(sines, 1e-300)))
        if self.readout_motion is not None:
            later, moves = self._readout_motion_at(directions, frames)
            turns, starts = later @ turns, np.einsum("nij,nj->ni", later, starts) + moves
        return pose(turns, starts)

    def seeing(
        self, points_rig: np.ndarray, frames: np.ndarray, signs: np.ndarray | None = None
    ) -> np.ndarray:
        """Vectors (N, 3) along the directions in which pictures of frames (N,) show points (N, 3).

        The lens that faces a point sees it, or the lens of `signs` as in `origins`. Points are in
        the rig frame in the middle of the readout.
        """
        vectors = self._directions_in_panorama(points_rig, frames, signs)
        if self.readout_motion is None:
            return vectors
        for _ in range(_NUM_ROW_TIME_PASSES):
            units = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)
            turns, moves = self._readout_motion_at(units, frames, signs)
            local = np.einsum("nij,nj->ni", np.swapaxes(turns, 1, 2), points_rig - moves)
            vectors = self._directions_in_panorama(local, frames, signs)
        return vectors

    def calibrated(self, directions: np.ndarray) -> np.ndarray:
        """Directions of pixels by the estimated lenses, given their directions (N, 3) in
        panoramas."""
        if self.reference_calibration is None or self.fisheyes is None:
            return directions
        return recalibrated(directions, self.reference_calibration, self.fisheyes)

    def _readout_motion_at(
        self, directions: np.ndarray, frames: np.ndarray, signs: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Rotations (N, 3, 3) and translations (N, 3) of frames (N,) from the middle of the readout
        to the rows of unit directions (N, 3)."""
        assert self.readout_motion is not None
        moved = (
            self.fractions(directions, frames, signs=signs)[:, None] * self.readout_motion[frames]
        )
        return _rotations(moved[:, :3]), moved[:, 3:]

    def _directions_in_panorama(
        self, points: np.ndarray, frames: np.ndarray, signs: np.ndarray | None
    ) -> np.ndarray:
        """Vectors (N, 3) along the directions in which a stitcher shows points (N, 3)."""
        origins = self.origins(points, frames, signs)
        vectors = points - origins
        if self.reference_calibration is not None and self.fisheyes is not None:
            lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
            units = vectors / np.maximum(lengths, 1e-300)
            behind = None if signs is None else signs < 0
            return lengths * recalibrated(units, self.fisheyes, self.reference_calibration, behind)
        if not self.inverse_stitch_radius:
            return vectors
        lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
        units, near = vectors / np.maximum(lengths, 1e-300), self.inverse_stitch_radius * origins
        along = np.sum(near * units, axis=1, keepdims=True)
        left = 1 + along**2 - np.sum(near**2, axis=1, keepdims=True)
        return lengths * (near + (np.sqrt(np.maximum(left, 0)) - along) * units)

    def blended(self, directions: np.ndarray, frames: np.ndarray) -> np.ndarray:
        """True (N,) for directions (N, 3) of frames (N,) at which both lenses' pictures are
        blended."""
        lengths = np.linalg.norm(directions, axis=1)
        return np.abs(self.own(directions, frames)[:, 2]) < np.sin(self.band_rad) * lengths

    def seen(self, keypoints: Keypoints) -> Keypoints:
        """Keypoints as rays that start at their lens, at the pose of the frame's middle."""
        if not self:
            return keypoints
        directions, origins = self.rays(keypoints.bearings_rig, keypoints.frames())
        return replace(keypoints, bearings_rig=directions, origins_rig=origins)

    def clear(self, tracks: Tracks, keypoints: Keypoints) -> Tracks:
        """Tracks without observations in the blended band, nor the points observed only there."""
        if not self.band_rad:
            return tracks
        bearings = keypoints.bearings_rig[keypoints.rows(tracks)]
        return tracks.of_observations(~self.blended(bearings, tracks.frames))

    def scaled(self, scale: float) -> "Lenses":
        """The lenses in another unit of length: one map unit is `scale` of the new ones."""
        readout_motion = (
            None
            if self.readout_motion is None
            else self.readout_motion * np.repeat([1.0, scale], 3)
        )
        return replace(
            self,
            centre=scale * self.centre,
            inverse_stitch_radius=self.inverse_stitch_radius / scale,
            readout_motion=readout_motion,
        )

    def cut_anew(self) -> "Lenses":
        """The lenses for panoramas cut anew, by the estimated calibration of raw pairs."""
        return replace(
            self, reference_calibration=self.fisheyes or self.reference_calibration, fisheyes=None
        )

    def taken(self, rows: np.ndarray) -> "Lenses":
        """The lenses of some frames (F',) only."""
        axes = None if self.axes is None else self.axes[rows]
        readout_motion = None if self.readout_motion is None else self.readout_motion[rows]
        return replace(self, axes=axes, readout_motion=readout_motion)

    def of_frame(self, frame: int) -> "Lenses":
        """The lenses of one frame, which then has index 0."""
        return self.taken(np.array([frame]))


ONE_CENTRE = Lenses()


def facing(directions: np.ndarray) -> np.ndarray:
    """Signs (N,) of directions (N, 3) in the lenses' frame: 1 = front lens, -1 = back lens."""
    return np.where(directions[:, 2] >= 0, 1.0, -1.0)


def rows_run(pair: Pair) -> np.ndarray:
    """Directions (2, 3) in which pictures' rows follow one another in either lens, rig frame."""
    return np.array([rotation_of(lens)[:, 1] for lens in pair])


def _rotations(vectors: np.ndarray) -> np.ndarray:
    """Rotations (N, 3, 3) of small rotation vectors (N, 3)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(vectors).as_matrix()
