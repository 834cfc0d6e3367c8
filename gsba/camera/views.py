"""The pinhole cameras that panoramas are cut into: cube faces, or faces of one lens each.

Faces of one lens have its centre, axes of the lenses, and leave out the blended band; they are cut
as with all rows read in the middle of the exposure, at the depths that map points give.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from gsba.camera.cameras import Cameras
from gsba.camera.lens import Lenses
from gsba.camera.pictures import LensGrid, Picture, panorama
from gsba.camera.rig import RIG_R_FACE, CubeRig
from gsba.camera.sphere import row_bands
from gsba.geometry import pose, unit
from gsba.log import GsbaError
from gsba.types import FACES, PictureFormat, Reconstruction

FAR_DEPTH = 1e9  # map units: depth from which both lenses see alike
_NODES_ACROSS_FACE = 33  # nodes across a face of the interpolated offsets, which vary over tens of
# degrees
_STEP = 2  # pixels between computed directions of a view, linear between to .003 pixels


@dataclass(frozen=True, slots=True)
class View:
    """A pinhole camera in the rig of a dataset."""

    name: str
    width: int  # pixels
    height: int  # pixels
    focal: float  # pixels
    principal: tuple[float, float]  # pixels, corner origin
    rig_R_view: np.ndarray  # (3, 3) float64
    centre: np.ndarray  # (3,) float64, rig frame, unit of the poses

    @property
    def rig_T_view(self) -> np.ndarray:
        """(4, 4) float64."""
        return pose(self.rig_R_view, self.centre)

    @property
    def intrinsics(self) -> tuple[object, ...]:
        """Key of the intrinsics: equal for views that one camera can stand for."""
        return self.width, self.height, self.focal, self.principal

    def rays(self, pixels: np.ndarray) -> np.ndarray:
        """Unit directions (..., 3), rig frame, of pixels (..., 2)."""
        xy = (pixels - self.principal) / self.focal
        rays = np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1)
        return unit(rays) @ self.rig_R_view.T

    def finer(self, times: int) -> "View":
        """The view with `times` as many pixels either way."""
        u, v = self.principal
        size = {"width": times * self.width, "height": times * self.height}
        return replace(self, **size, focal=times * self.focal, principal=(times * u, times * v))


def cube_views(faces: tuple[str, ...], size: int) -> tuple[View, ...]:
    """Faces of `size` pixels and 90 degrees, of one centre."""
    half = size / 2
    return tuple(
        View(face, size, size, half, (half, half), RIG_R_FACE[FACES.index(face)], np.zeros(3))
        for face in faces
    )


def rig_views(rig: CubeRig) -> tuple[View, ...]:
    """The faces of a cube rig, in FACES order."""
    principal = (rig.principal, rig.principal)
    return tuple(
        View(face, rig.size, rig.size, float(rig.focal), principal, rig_R_face, np.zeros(3))
        for face, rig_R_face in zip(FACES, RIG_R_FACE, strict=True)
    )


def lens_views(lenses: Lenses, size: int) -> tuple[View, ...]:
    """Ten views of two lenses, with pixels as large as those of cube faces of `size`. GsbaError:
    there are more than two lenses."""
    if lenses.num_lenses != 2:
        raise GsbaError(
            f"the camera has {lenses.num_lenses} lenses, and faces of one lens each are cut for "
            "two back to back: use --images cube, panorama or, of raw frames, fisheye"
        )
    towards, along = _side_extents(lenses.band_rad)
    short, long = 2 * int(size / 2 * towards), 2 * int(np.ceil(size / 2 * along))
    tilt = np.pi / 4 + np.arctan(short / size)  # its edge meets the whole face's
    views = []
    for whole in cube_views(FACES, size):
        axis = whole.rig_R_view[:, 2]
        if axis[2] != 0:
            views.append(replace(whole, centre=axis[2] * lenses.centre))
            continue
        for lens, sign in (("front", 1.0), ("back", -1.0)):
            ahead = np.array([0, 0, sign])
            forward = np.cos(tilt) * ahead + np.sin(tilt) * axis
            seamwards = np.cos(tilt) * axis - np.sin(tilt) * ahead
            if axis[0]:  # beside the lens, upright
                down = np.array([0.0, 1, 0])
                right, width, height = np.cross(down, forward), short, long
            else:
                down = seamwards * np.sign(axis[1])
                right, width, height = np.cross(down, forward), long, short
            turn = np.column_stack([right, down, forward])
            side = View("", width, height, size / 2, (width / 2, height / 2), turn, np.zeros(3))
            views.append(replace(side, name=f"{whole.name}_{lens}", centre=sign * lenses.centre))
    return tuple(views)


def _side_extents(band_rad: float) -> tuple[float, float]:
    """Half the extents, tangents, of a side view towards the seam, where it ends, and along it."""

    def along_at(half: float) -> float:
        tilt = np.pi / 4 + half
        angles = np.linspace(np.pi / 4, np.pi / 2, 181)  # from the lens's axis, on a diagonal
        beside, ahead = np.sin(angles) / np.sqrt(2), np.cos(angles)
        depth = beside * np.sin(tilt) + ahead * np.cos(tilt)
        inside = beside * np.cos(tilt) - ahead * np.sin(tilt) <= depth * np.tan(half)
        return float((beside / depth)[inside].max())

    low, high = 0.0, np.pi / 8
    for _ in range(40):
        half = (low + high) / 2
        tilt, towards, along = np.pi / 4 + half, np.tan(half), along_at(half)
        corner = np.cos(tilt) - towards * np.sin(tilt)  # along the lens's axis
        clear = corner > np.sin(band_rad) * np.sqrt(1 + towards**2 + along**2)
        low, high = (half, high) if clear else (low, half)
    return float(np.tan(low)), along_at(low)


def seen_from_lenses(reconstruction: Reconstruction, cameras: Cameras) -> Reconstruction:
    """Poses with the lenses' axes, and rays from the lenses' centres in the middle of the
    readout."""
    return _by_camera(reconstruction, cameras, _seen_from_lenses)


def _by_camera(
    reconstruction: Reconstruction,
    cameras: Cameras,
    see: Callable[[Reconstruction, Lenses], Reconstruction],
) -> Reconstruction:
    """Poses and rays of each camera's frames, as `see` makes them by that camera's lenses."""
    if not cameras.of_frame:
        return see(reconstruction, cameras.only)
    poses = reconstruction.world_T_rigs.copy()
    bearings = reconstruction.observation_bearings.copy()
    origins = reconstruction.observation_origins
    origins = None if origins is None else origins.copy()
    of_frame = np.array(cameras.of_frame)
    for number, lenses in enumerate(cameras.lenses):
        found, frames = see(reconstruction, lenses), of_frame == number
        rows = frames[reconstruction.observation_frames]
        poses[frames] = found.world_T_rigs[frames]
        bearings[rows] = found.observation_bearings[rows]
        if origins is not None and found.observation_origins is not None:
            origins[rows] = found.observation_origins[rows]
    return replace(
        reconstruction,
        world_T_rigs=poses,
        observation_bearings=bearings,
        observation_origins=origins,
    )


def _seen_from_lenses(reconstruction: Reconstruction, lenses: Lenses) -> Reconstruction:
    if lenses.readout_motion is not None:
        bearings, frames = reconstruction.observation_bearings, reconstruction.observation_frames
        starts = lenses.origins(bearings, frames)
        rays = unit(observed_points(reconstruction) - starts)
        reconstruction = replace(
            reconstruction, observation_bearings=rays, observation_origins=starts
        )
    if lenses.axes is None:
        return reconstruction
    turns = lenses.axes[reconstruction.observation_frames]
    origins = reconstruction.observation_origins
    return replace(
        reconstruction,
        world_T_rigs=turned_rigs(reconstruction.world_T_rigs, lenses.axes),
        observation_bearings=np.einsum("oji,oj->oi", turns, reconstruction.observation_bearings),
        observation_origins=None if origins is None else np.einsum("oji,oj->oi", turns, origins),
    )


def turned_rigs(world_T_rigs: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Poses (W, 4, 4) of rigs whose axes are rotated by `turns` (W, 3, 3)."""
    turned = world_T_rigs.copy()
    turned[:, :3, :3] = turned[:, :3, :3] @ turns
    return turned


def shown_in_pictures(reconstruction: Reconstruction, cameras: Cameras) -> Reconstruction:
    """Observed points as bearings along the directions in which pictures show them."""
    return _by_camera(reconstruction, cameras, _shown_in_pictures)


def _shown_in_pictures(reconstruction: Reconstruction, lenses: Lenses) -> Reconstruction:
    if lenses.readout_motion is None:
        return reconstruction
    frames = reconstruction.observation_frames
    shown = unit(lenses.seeing(observed_points(reconstruction), frames))
    origins = lenses.origins(shown, frames)
    return replace(reconstruction, observation_bearings=shown, observation_origins=origins)


@dataclass(frozen=True, slots=True)
class Scenes:
    """Points that frames observe."""

    world_T_rigs: np.ndarray  # (F, 4, 4) float64
    points_world: np.ndarray  # (J, 3) float64
    seen: np.ndarray  # indices of observed points, frame by frame
    bounds: np.ndarray  # (F + 1,) int64: frame f observes seen[bounds[f]:bounds[f + 1]]

    def __call__(self, f: int) -> np.ndarray:
        """Points (N, 3) that frame f observes, in its rig frame."""
        pose = self.world_T_rigs[f]
        return (self.points_world[self._of(f)] - pose[:3, 3]) @ pose[:3, :3]

    def taken(self, rows: np.ndarray) -> "Scenes":
        """The scenes of some frames (F',) only."""
        seen = [self._of(f) for f in rows]
        points, numbers = np.unique(np.concatenate(seen), return_inverse=True)
        bounds = np.cumsum([0, *map(len, seen)])
        return Scenes(self.world_T_rigs[rows], self.points_world[points], numbers, bounds)

    def _of(self, f: int) -> np.ndarray:
        return self.seen[self.bounds[f] : self.bounds[f + 1]]


def scenes_of(reconstruction: Reconstruction) -> Scenes:
    """The points that a reconstruction's frames observe."""
    poses, points = reconstruction.world_T_rigs, reconstruction.points_world
    return scenes_around(
        poses, points, reconstruction.observation_points, reconstruction.observation_frames
    )


def scenes_around(
    world_T_rigs: np.ndarray, points_world: np.ndarray, points: np.ndarray, frames: np.ndarray
) -> Scenes:
    """Scenes of poses (F, 4, 4), points (J, 3), and the observed `points` and `frames`, both
    (O,)."""
    order = np.argsort(frames, kind="stable")
    bounds = np.searchsorted(frames[order], np.arange(len(world_T_rigs) + 1))
    return Scenes(world_T_rigs, points_world, points[order], bounds)


def observed_points(reconstruction: Reconstruction) -> np.ndarray:
    """Ends (O, 3), rig frames, of rays of two lenses, at the depths of the points they observe."""
    starts = reconstruction.observation_origins
    assert starts is not None
    poses = reconstruction.world_T_rigs[reconstruction.observation_frames]
    ends = reconstruction.points_world[reconstruction.observation_points]
    reaches = ends - poses[:, :3, 3] - np.einsum("oij,oj->oi", poses[:, :3, :3], starts)
    depths = np.linalg.norm(reaches, axis=1)
    return starts + depths[:, None] * reconstruction.observation_bearings


class ViewCutter:
    """Cuts the views of one frame out of pictures of it."""

    def __init__(
        self, views: tuple[View, ...], lenses: Lenses, frame: int, scene: np.ndarray | None = None
    ) -> None:
        """Compute the offset from each view's rays to directions in the frame-th frame of the
        lenses, at the depths of scene points (N, 3), rig frame; None = everything is far. Rolling
        shutter is undone at these depths."""
        self._views = views
        self._offsets = [_offsets(view, lenses, frame, scene) for view in views]
        self._turn = np.eye(3) if lenses.axes is None else lenses.axes[frame]
        self._centres = lenses.centres
        self.focal = views[0].focal  # pixels

    def cut(self, pictures: Sequence[Picture]) -> Iterator[np.ndarray]:
        """Images (height, width[, C]), bicubic, one after the other, of a picture of all
        directions, or of those (L) of raw lenses."""
        for view, offsets in zip(self._views, self._offsets, strict=True):
            lens = nearest_lens(view, self._centres) if len(pictures) > 1 else 0
            yield self._view(view, offsets, pictures[lens], cv2.INTER_CUBIC)

    def cut_mask(self, mask: np.ndarray) -> list[np.ndarray]:
        """Masks (height, width) cut out of one of a panorama (H, 2 H), bool or float32 weights."""
        picture = panorama(mask.astype(np.uint8) if mask.dtype == bool else mask)
        pairs = zip(self._views, self._offsets, strict=True)
        parts = [self._view(*pair, picture, cv2.INTER_NEAREST) for pair in pairs]
        return [part.astype(mask.dtype) for part in parts]

    def _view(self, view: View, offsets: np.ndarray, picture: Picture, how: int) -> np.ndarray:
        """A view (height, width[, C]) of a picture."""
        image, grid = picture.image, picture.grid
        out = np.empty((view.height, view.width, *image.shape[2:]), image.dtype)
        for rows in row_bands(view.height):
            height = rows.stop - rows.start
            down = rows.start + _nodes_along(height)
            pixels = np.stack(np.meshgrid(_nodes_along(view.width), down), axis=-1)
            nodes = pixels * ((_NODES_ACROSS_FACE - 1) / np.array([view.width, view.height]))
            nodes = nodes.astype(np.float32)
            moved = cv2.remap(
                offsets, nodes[..., 0], nodes[..., 1], cv2.INTER_CUBIC,
                borderMode=cv2.BORDER_REPLICATE,
            )  # fmt: skip
            rays, size = view.rays(pixels) @ self._turn.T + moved, (height, view.width)
            if isinstance(grid, LensGrid):  # its places have no seam and no pole
                places = _between_nodes(grid.places(rays), size)
            else:
                places = grid.places(_between_nodes(rays, size))
            out[rows] = picture.at(places, how).reshape(out[rows].shape)
        return out


def _nodes_along(pixels: int) -> np.ndarray:
    """Places, in pixels, of the nodes along a side of a view, one of them beyond either end."""
    return _STEP * (np.arange(-(-pixels // _STEP) + 2) - 0.5)


def _between_nodes(values: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Values (h, w, C) float32 at all pixels of a size (h, w), linear between those at nodes."""
    known = values.astype(np.float32)
    known = cv2.resize(known, None, fx=_STEP, fy=_STEP, interpolation=cv2.INTER_LINEAR)
    return known[_STEP : _STEP + size[0], _STEP : _STEP + size[1]]


def nearest_lens(view: View, centres: np.ndarray) -> int:
    """The lens in whose centre, of (L, 3), a view is."""
    return int(np.argmin(np.linalg.norm(centres - view.centre, axis=1)))


def _offsets(view: View, lenses: Lenses, frame: int, scene: np.ndarray | None) -> np.ndarray:
    """Offsets (N, N, 3) float32 from a view's rays to directions in panoramas, corner to corner."""
    places = np.linspace(0, [view.width, view.height], _NODES_ACROSS_FACE)
    rays = view.rays(np.stack(np.meshgrid(*places.T), axis=-1)).reshape(-1, 3)
    turned = rays if lenses.axes is None else rays @ lenses.axes[frame].T
    frames = np.full(len(rays), frame)
    ends = FAR_DEPTH * turned
    if scene is not None and len(scene):
        ends = lenses.origins(turned, frames) + depths_along(turned, scene)[:, None] * turned
    shown = unit(lenses.seeing(ends, frames))
    return (shown - turned).reshape(_NODES_ACROSS_FACE, _NODES_ACROSS_FACE, 3).astype(np.float32)


def depths_along(directions: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Depths (N,) of the scene in unit directions (N, 3), by points (M, 3) around.

    Each lies on a plane through the points nearest in direction: there, inverse depths are linear
    in directions. Points off it count little; where they leave its tilt open, it faces the camera.
    """
    from scipy.spatial import KDTree

    lengths = np.linalg.norm(points, axis=1)
    units, near = points / lengths[:, None], min(12, len(points))
    apart, rows = KDTree(units).query(directions, k=near)
    apart, rows = apart.reshape(-1, near), rows.reshape(-1, near)
    spread = np.maximum(apart[:, near // 2, None], np.deg2rad(3.0))
    weights, inverse = np.exp(-((apart / spread) ** 2)), 1 / lengths[rows]
    order = np.argsort(inverse, axis=1)
    heights = np.cumsum(np.take_along_axis(weights, order, axis=1), axis=1)
    half = np.argmax(heights >= heights[:, -1:] / 2, axis=1)
    half = np.take_along_axis(order, half[:, None], axis=1)
    middle = np.take_along_axis(inverse, half, axis=1)[:, 0]
    flat, beside = middle[:, None] * directions, units[rows]
    tilt, left = np.zeros_like(flat), inverse - np.einsum("nki,ni->nk", beside, flat)
    facing_us = (0.05 * spread**2 * weights.sum(axis=1, keepdims=True))[..., None] * np.eye(3)
    for _ in range(4):  # reweighting rounds of the plane fit
        # a relative error of depth of .1 counts as off a plane
        off = (left - np.einsum("nki,ni->nk", beside, tilt)) / (0.1 * middle[:, None])
        shares = weights / (1 + off**2)
        normal = np.einsum("nk,nki,nkj->nij", shares, beside, beside) + facing_us
        right = np.einsum("nk,nki,nk->ni", shares, beside, left)
        tilt = np.linalg.solve(normal, right[..., None])[..., 0]
    found = np.einsum("ni,ni->n", flat + tilt, directions)
    return 1 / np.clip(found, inverse.min(axis=1), inverse.max(axis=1))


def views_for(kind: PictureFormat, size: int, lenses: Lenses) -> tuple[View, ...]:
    """The views of a dataset of one camera's frames, faces of `size` pixels."""
    if lenses and kind.panoramic:
        return lens_views(lenses, size)
    return cube_views(kind.faces or FACES, size)


@dataclass(frozen=True, slots=True)
class Optics:
    """Lenses, and depths of the scene around them. One centre by default."""

    lenses: Lenses = field(default_factory=Lenses)  # in the unit of the poses
    scenes: Callable[[int], np.ndarray] | None = None  # points (N, 3) around a frame, rig frame, by
    # its index; None = everything is far

    def __bool__(self) -> bool:
        return bool(self.lenses)

    @classmethod
    def of(cls, cameras: Cameras, reconstruction: Reconstruction) -> "Optics":
        """Lenses of the frames that a reconstruction was made from.

        Of more than two lenses there are no faces of one lens each, and of several cameras none
        that all frames share: they count as one centre.
        """
        if len(cameras.lenses) > 1 or cameras.only.num_lenses > 2:
            return ONE_EYE
        return cls(cameras.only, scenes_of(reconstruction))

    def views(self, size: int) -> tuple[View, ...]:
        """Six faces of `size` pixels and 90 degrees, or as dense faces of one lens each."""
        return lens_views(self.lenses, size) if self else rig_views(CubeRig(size, np.pi / 2))

    def cutter(self, views: tuple[View, ...], frame: int) -> ViewCutter:
        """The cutter of views out of the pictures of a frame."""
        return ViewCutter(views, self.lenses, frame, self.scenes and self.scenes(frame))

    def own(self, world_T_rigs: np.ndarray, frames: np.ndarray) -> np.ndarray:
        """Poses (W, 4, 4) of rigs that have the lenses' axes, from those of frames (W,)."""
        axes = self.lenses.axes
        return world_T_rigs if axes is None else turned_rigs(world_T_rigs, axes[frames])


ONE_EYE = Optics()
