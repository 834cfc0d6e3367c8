"""Two lenses or more, read row by row: which one saw a bearing, from where, and when.

A 360-degree camera has two fisheyes back to back, or more lenses around it, whose centres are some
centimetres apart. A panorama stitched
at infinity shows each direction as the lens that faces it saw it: a ray that starts at that lens.
A panorama stitched for a radius puts things at that distance from the camera's middle where the
middle would see them: the ray goes from the lens to that place.
Rows of each fisheye are read one after another, while the camera moves: a ray belongs to the pose
of its row, which a twist over the readout time carries to the pose of the frame's middle.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from gsba.camera.fisheye import Rig, facing, optical_axes, pixels_of, recalibrated, rotation_of
from gsba.geometry import pose, unit


@dataclass(frozen=True, slots=True)
class Lenses:
    """The camera of a sequence. One centre, one instant by default. The lenses' frame has its
    origin in the middle of the lenses' centres, and z along the front lens's axis."""

    centre: np.ndarray = field(default_factory=lambda: np.zeros(3))
    # (3 (L - 1),) float64, centres of all lenses but the last one, the front one first, lenses'
    # frame, map units; the last one's is minus their sum: of a pair it is opposite
    inverse_stitch_radius: float = 0.0  # 1 / map units; 0 = panoramas are stitched at infinity
    band_rad: float = 0.0  # half width of the seam's band in which both lenses are blended
    row_directions: np.ndarray | None = None  # (L, 3) float64, unit, lenses' frame: direction in
    # which each lens reads its rows; None = global shutter
    readout_motion: np.ndarray | None = None  # (F, 6) float64, motion of each frame from its first
    # to its last row, [rotation rad, translation map units], rig frame; None = none
    axes: np.ndarray | None = None  # (F, 3, 3) float64, rig_R_lenses of each frame, where a
    # stabiliser rotated the panorama against them; None = the rig's axes
    reference_calibration: Rig | None = None  # by which panoramas of raw pairs were cut; None =
    # the frames are panoramas
    fisheyes: Rig | None = None  # lenses of raw pairs as estimated; None = reference_calibration
    optical_axes: np.ndarray = field(default_factory=lambda: np.array([[0.0, 0, 1], [0, 0, -1]]))
    # (L, 3) float64, unit, lenses' frame: each direction is seen by the lens whose axis is nearest

    def __bool__(self) -> bool:
        return bool(self.centre.any()) or self.fisheyes is not None

    @property
    def parts(self) -> tuple[bool, ...]:
        """Which parts were taken: a readout, axes of frames' own, raw lenses of their own, a
        stitching radius."""
        optional = self.readout_motion, self.axes, self.fisheyes
        return (*(part is not None for part in optional), bool(self.inverse_stitch_radius))

    @property
    def num_lenses(self) -> int:
        """L."""
        return len(self.optical_axes)

    @property
    def centres(self) -> np.ndarray:
        """Centres (L, 3) of all lenses, lenses' frame, map units."""
        return all_centres(self.centre)

    @property
    def baseline(self) -> float:
        """Distance between the centres of the front lens and the next one, map units."""
        centres = self.centres
        return float(np.linalg.norm(centres[0] - centres[1]))

    def facing(self, directions: np.ndarray, frames: np.ndarray) -> np.ndarray:
        """Lens (N,) int64 that faces directions (N, 3) in the rig frames of frames (N,)."""
        return facing(self.own(directions, frames), self.optical_axes)

    def own(self, directions: np.ndarray, frames: np.ndarray) -> np.ndarray:
        """Directions (N, 3) in the rig frames of frames (N,), rotated into the lenses' frame."""
        if self.axes is None:
            return directions
        return np.einsum("nji,nj->ni", self.axes[frames], directions)

    def origins(
        self, directions: np.ndarray, frames: np.ndarray, lens: np.ndarray | None = None
    ) -> np.ndarray:
        """Centres (N, 3) of the lenses that face directions (N, 3), both in the rig frame, or of
        given ones."""
        lens = self.facing(directions, frames) if lens is None else lens
        centres = self.centres[lens]
        if self.axes is None:
            return centres
        return np.einsum("nij,nj->ni", self.axes[frames], centres)

    def by_centre(
        self, by_origin: np.ndarray, directions: np.ndarray, frames: np.ndarray
    ) -> np.ndarray:
        """Jacobians (N, D, 3 (L - 1)) by `centre`, from those (N, D, 3) by the rays' origins in the
        rig frames."""
        lens, last = self.facing(directions, frames), self.num_lenses - 1
        own = by_origin if self.axes is None else by_origin @ self.axes[frames]
        shares = (lens[:, None] == np.arange(last)) - 1.0 * (lens == last)[:, None]
        return np.concatenate([share[:, None, None] * own for share in shares.T], axis=2)

    def fractions(
        self,
        directions: np.ndarray,
        frames: np.ndarray,
        row_directions: np.ndarray | None = None,
        lens: np.ndarray | None = None,
    ) -> np.ndarray:
        """Time at which frames (N,) read unit directions (N, 3), in readout times, (N,); 0 = the
        middle.

        Raw pairs have known rows. Otherwise a lens is assumed to be equidistant; the estimated
        motion absorbs the deviation. The lens is the one that faces a direction, or `lens` as in
        `origins`.
        """
        row_directions = self.row_directions if row_directions is None else row_directions
        if row_directions is None:
            return np.zeros(len(directions))
        if self.reference_calibration is not None:
            lens, pixels = pixels_of(self.reference_calibration, directions, lens)
            heights = np.array([one.height for one in self.reference_calibration])[lens]
            down = rows_run(self.reference_calibration)
            return np.sign(np.sum(down * row_directions, axis=1))[lens] * (
                pixels[:, 1] / heights - 0.5
            )
        own = self.own(directions, frames)
        lens = facing(own, self.optical_axes) if lens is None else lens
        axes = self.optical_axes[lens]
        ahead = np.einsum("ni,ni->n", own, axes)
        across = own - ahead[:, None] * axes
        radii = np.linalg.norm(across, axis=1)
        angles = np.arctan2(radii, ahead)
        along = np.einsum("ni,ni->n", across, np.asarray(row_directions)[lens])
        # 200 degrees: a fisheye that fills its sensor, first row to last
        return angles / (2 * np.deg2rad(100.0)) * along / np.maximum(radii, 1e-12)

    def rows_down(self) -> np.ndarray:
        """1 (L,) for the picture of a raw lens that is read from its top row down, -1 for one that
        is read from its bottom row up."""
        assert self.reference_calibration is not None and self.row_directions is not None
        return np.sign(np.sum(rows_run(self.reference_calibration) * self.row_directions, axis=1))

    def swept(self, frame: int) -> np.ndarray:
        """Poses (L, 2, 4, 4) of the rig when each raw lens reads its top and bottom edge, relative
        to the rig in the middle of the readout."""
        assert (
            self.reference_calibration is not None
            and self.readout_motion is not None
            and self.row_directions is not None
        )
        halves = np.outer(self.rows_down(), [-0.5, 0.5])
        moved = np.multiply.outer(halves, self.readout_motion[frame])
        turns = _rotations(moved[..., :3].reshape(-1, 3)).reshape(*moved.shape[:2], 3, 3)
        return pose(turns, moved[..., 3:])

    def rays(self, directions: np.ndarray, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Directions and origins (N, 3) of the rays that frames (N,) show in directions (N, 3), rig
        frame in the middle of the readout."""
        origins, seen = self.origins(directions, frames), self.calibrated(directions)
        if self.inverse_stitch_radius:
            seen = unit(directions - self.inverse_stitch_radius * origins)
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
        self, points_rig: np.ndarray, frames: np.ndarray, lens: np.ndarray | None = None
    ) -> np.ndarray:
        """Vectors (N, 3) along the directions in which pictures of frames (N,) show points (N, 3),
        rig frame in the middle of the readout, by the lens that faces a point, or `lens` as in
        `origins`."""
        vectors = self._directions_in_panorama(points_rig, frames, lens)
        if self.readout_motion is None:
            return vectors
        for _ in range(4):  # fixed-point passes between pixel and time
            units = unit(vectors)
            turns, moves = self._readout_motion_at(units, frames, lens)
            local = np.einsum("nij,nj->ni", np.swapaxes(turns, 1, 2), points_rig - moves)
            vectors = self._directions_in_panorama(local, frames, lens)
        return vectors

    def calibrated(self, directions: np.ndarray) -> np.ndarray:
        """Directions of pixels by the estimated lenses, given their directions (N, 3) in
        panoramas."""
        if self.reference_calibration is None or self.fisheyes is None:
            return directions
        return recalibrated(directions, self.reference_calibration, self.fisheyes)

    def _readout_motion_at(
        self, directions: np.ndarray, frames: np.ndarray, lens: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Rotations (N, 3, 3) and translations (N, 3) from mid-readout to directions' rows."""
        assert self.readout_motion is not None
        moved = self.fractions(directions, frames, lens=lens)[:, None] * self.readout_motion[frames]
        return _rotations(moved[:, :3]), moved[:, 3:]

    def _directions_in_panorama(
        self, points: np.ndarray, frames: np.ndarray, lens: np.ndarray | None
    ) -> np.ndarray:
        """Vectors (N, 3) along the directions in which a stitcher shows points (N, 3)."""
        origins = self.origins(points, frames, lens)
        vectors = points - origins
        if self.fisheyes is None and not self.inverse_stitch_radius:
            return vectors
        lengths, units = np.linalg.norm(vectors, axis=1, keepdims=True), unit(vectors)
        if self.reference_calibration is not None and self.fisheyes is not None:
            return lengths * recalibrated(units, self.fisheyes, self.reference_calibration, lens)
        near = self.inverse_stitch_radius * origins
        along = np.sum(near * units, axis=1, keepdims=True)
        left = 1 + along**2 - np.sum(near**2, axis=1, keepdims=True)
        return lengths * (near + (np.sqrt(np.maximum(left, 0)) - along) * units)

    def blended(self, directions: np.ndarray, frames: np.ndarray) -> np.ndarray:
        """True (N,) for directions (N, 3) of frames (N,) at which two lenses' pictures are
        blended."""
        lengths = np.linalg.norm(directions, axis=1)
        apart = seam_sines(self.own(directions, frames), self.optical_axes)
        return apart < np.sin(self.band_rad) * lengths

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
        found = self.fisheyes or self.reference_calibration
        axes = self.optical_axes if found is None else optical_axes(found)
        return replace(self, reference_calibration=found, fisheyes=None, optical_axes=axes)

    @classmethod
    def of_raw(cls, rig: Rig, band_rad: float = 0.0) -> "Lenses":
        """Raw lenses that panoramas were cut by, their centres not known yet."""
        centre = np.zeros(3 * (len(rig) - 1))
        axes = optical_axes(rig)
        return cls(centre, band_rad=band_rad, reference_calibration=rig, optical_axes=axes)

    @classmethod
    def ring(cls, yaws: np.ndarray) -> "Lenses":
        """Level lenses that look in directions, radians (L,) from the panorama's middle to
        the right."""
        axes = np.array([[np.sin(yaw), 0.0, np.cos(yaw)] for yaw in yaws])
        return cls(np.zeros(3 * (len(axes) - 1)), optical_axes=axes)

    def taken(self, rows: np.ndarray) -> "Lenses":
        """The lenses of some frames (F',) only."""
        axes = None if self.axes is None else self.axes[rows]
        readout_motion = None if self.readout_motion is None else self.readout_motion[rows]
        return replace(self, axes=axes, readout_motion=readout_motion)

    def of_frame(self, frame: int) -> "Lenses":
        """The lenses of one frame, which then has index 0."""
        return self.taken(np.array([frame]))


ONE_CENTRE = Lenses()


def all_centres(centre: np.ndarray) -> np.ndarray:
    """Centres (L, 3) of lenses whose mean is zero, from all but the last one's (3 (L - 1),)."""
    given = centre.reshape(-1, 3)
    return np.concatenate([given, -given.sum(axis=0, keepdims=True)])


def seam_sines(directions: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Distances (...,) of vectors (..., 3) from the nearest seam of lenses with axes (L, 3): that
    of two lenses is the plane between their axes."""
    along = directions @ axes.T
    nearest = np.argmax(along, axis=-1)
    best = np.take_along_axis(along, nearest[..., None], axis=-1)
    apart = np.linalg.norm(axes[nearest][..., None, :] - axes, axis=-1)
    sines = np.full(along.shape, np.inf)
    np.divide(best - along, apart, out=sines, where=apart > 0)
    return sines.min(axis=-1)


def rows_run(rig: Rig) -> np.ndarray:
    """Directions (L, 3) in which pictures' rows follow one another in each lens, rig frame."""
    return np.array([rotation_of(lens)[:, 1] for lens in rig])


def _rotations(vectors: np.ndarray) -> np.ndarray:
    """Rotations (N, 3, 3) of small rotation vectors (N, 3)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(vectors).as_matrix()
