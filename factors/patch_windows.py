"""Patches of a sphere image observed in others: their table, and small windows of pixels around
them, gathered frame by frame: memory grows with observations, never with the images."""

from dataclasses import dataclass, replace

import numpy as np

from factors._photometric_kernels import CODE_SCALE, CODE_ZERO
from factors.bearing import tangent_basis
from factors.sphere_image import SphereImage

PAD = 2  # coefficients beyond the border: the support of the spline
_MAX_ZOOM = 2.0  # largest ratio of a patch's size between host and target, either way


@dataclass(frozen=True, slots=True)
class PatchViews:
    """Poses of the local views by which a rig's lenses show patches in its panorama.

    They are fixed while poses are solved: a patch that moves to the other lens would differ.
    """

    rig_T_hosts: np.ndarray  # (P, 4, 4) float64, views of hosts in their rigs
    rig_T_targets: np.ndarray  # (O, 4, 4) float64, views of targets in their rigs

    def of(self, rows: np.ndarray, observations: np.ndarray) -> "PatchViews":
        """The views of some patches (p,) and of observations (O,) bool."""
        return PatchViews(self.rig_T_hosts[rows], self.rig_T_targets[observations])


@dataclass(frozen=True, slots=True)
class PatchTable:
    """Patches and the frames in which they should be visible."""

    hosts: np.ndarray  # (P,) int, frame whose pixels are the template
    bearings_rig: np.ndarray  # (P, 3) float64, unit, centre in the host's rig frame, as in its
    # picture
    planes: np.ndarray  # (P, 3) float64, 1 / map units: inverse depth along the
    # bearing + x e1 + y e2: theta0 + x theta1 + y theta2, over the length of that vector
    plane_sigmas: np.ndarray  # (P, 3) float64, 1 / map units, prior of `planes`; inf = none
    offsets: np.ndarray  # (P + 1,) int64: patch p owns targets[offsets[p]:offsets[p + 1]]
    targets: np.ndarray  # (O,) int, frames, without the host and without repetition in a patch
    grid: np.ndarray  # (N, 2) float64, pixels on the tangent plane of the bearing
    views: "PatchViews | None" = None  # of rigs whose lenses have centres of their own

    def __len__(self) -> int:
        return len(self.hosts)

    @property
    def owners(self) -> np.ndarray:
        """(O,) patch of every observation."""
        return np.repeat(np.arange(len(self)), np.diff(self.offsets))

    def world_T_hosts(self, world_T_rigs: np.ndarray) -> np.ndarray:
        """Poses (P, 4, 4) of the views in which hosts show their patches."""
        world_T_hosts = world_T_rigs[self.hosts]
        return world_T_hosts if self.views is None else world_T_hosts @ self.views.rig_T_hosts

    def world_T_targets(self, world_T_rigs: np.ndarray) -> np.ndarray:
        """Poses (O, 4, 4) of the views in which targets show them."""
        world_T_targets = world_T_rigs[self.targets]
        return world_T_targets if self.views is None else world_T_targets @ self.views.rig_T_targets

    def select(self, observations: np.ndarray) -> "tuple[PatchTable, np.ndarray]":
        """The table of some observations (O,) bool, and the patches (p,) with any of them; frames
        keep their indices."""
        counts = np.bincount(self.owners[observations], minlength=len(self))
        rows = np.flatnonzero(counts)
        part = replace(
            self,
            hosts=self.hosts[rows],
            bearings_rig=self.bearings_rig[rows],
            planes=self.planes[rows],
            plane_sigmas=self.plane_sigmas[rows],
            offsets=np.concatenate([[0], np.cumsum(counts[rows])]),
            targets=self.targets[observations],
            views=None if self.views is None else self.views.of(rows, observations),
        )
        return part, rows

    def check(self, num_frames: int) -> None:
        """Refuse inconsistent arrays. ValueError: unequal lengths, indices out of range, values not
        finite, or a patch with its host or a repeated frame as target."""
        num = len(self.hosts)
        wanted = {
            "bearings_rig": (self.bearings_rig, (num, 3)),
            "planes": (self.planes, (num, 3)),
            "plane_sigmas": (self.plane_sigmas, (num, 3)),
            "offsets": (self.offsets, (num + 1,)),
        }
        if self.views is not None:
            wanted["rig_T_hosts"] = (self.views.rig_T_hosts, (num, 4, 4))
            wanted["rig_T_targets"] = (self.views.rig_T_targets, (len(self.targets), 4, 4))
        for name, (array, shape) in wanted.items():
            if np.shape(array) != shape:
                raise ValueError(f"{name} of {num} patches must be {shape}, not {np.shape(array)}")
        if not (np.all(np.isfinite(self.bearings_rig)) and np.all(np.isfinite(self.planes))):
            raise ValueError("bearings and planes must be finite")
        if np.any(np.abs(np.linalg.norm(self.bearings_rig, axis=1) - 1) > 1e-6):
            raise ValueError("bearings must be of length one")
        if not np.all(self.planes[:, 0] > 0) or not np.all(self.plane_sigmas > 0):
            raise ValueError("inverse depths and the sigmas of planes must be positive")
        if self.offsets[0] != 0 or np.any(np.diff(self.offsets) < 0):
            raise ValueError("offsets must start at 0 and not descend")
        if self.offsets[-1] != len(self.targets):
            raise ValueError(f"offsets end at {self.offsets[-1]}, targets at {len(self.targets)}")
        frames = np.concatenate([self.hosts, self.targets])
        if len(frames) and not (frames.min() >= 0 and frames.max() < num_frames):
            raise ValueError(f"frame index out of range 0..{num_frames - 1}")
        if np.any(self.hosts[self.owners] == self.targets):
            raise ValueError("a patch must not be observed in its host")
        if len(np.unique(self.owners * num_frames + self.targets)) < len(self.targets):
            raise ValueError("a patch must not be observed twice in one frame")


def pixel_grid(size: int, spacing_rad: float) -> np.ndarray:
    """(size^2, 2) float64 tangents of a square patch's pixels, row by row."""
    steps = spacing_rad * (np.arange(size) - (size - 1) / 2)
    x, y = np.meshgrid(steps, steps)
    return np.column_stack([x.ravel(), y.ravel()])


def patch_axes(bearings_rig: np.ndarray) -> np.ndarray:
    """(P, 3, 3) float64, rows: the unit bearing (P, 3) and the axes of its tangent plane."""
    return np.concatenate([bearings_rig[:, None], tangent_basis(bearings_rig)], axis=1)


def covisible_frames(table: PatchTable, num_frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Frame pairs f < g that share a patch, as sorted CSR rows: starts (F + 1,), columns (Q,)."""
    counts = np.diff(table.offsets)
    codes = [np.zeros(0, dtype=np.int64)]
    for count in np.unique(counts[counts > 0]):
        rows = np.flatnonzero(counts == count)
        seen = table.targets[table.offsets[rows][:, None] + np.arange(count)]
        frames = np.sort(np.column_stack([table.hosts[rows], seen]), axis=1).astype(np.int64)
        i, k = np.triu_indices(count + 1, 1)
        codes.append(np.unique(frames[:, i] * num_frames + frames[:, k]))
    first, second = np.divmod(np.unique(np.concatenate(codes)), num_frames)
    starts = np.zeros(num_frames + 1, dtype=np.int64)
    np.cumsum(np.bincount(first, minlength=num_frames), out=starts[1:])
    return starts, second


def patch_spans(
    table: PatchTable, world_T_rigs: np.ndarray, planes: np.ndarray, rows: np.ndarray
) -> np.ndarray:
    """Vectors (R, 3, 3), rows: to the patch's centre, and its derivatives along e1 and e2, in the
    views of targets, for observations `rows (R,)`, times the inverse depth."""
    owners = table.owners[rows]
    host = table.world_T_hosts(world_T_rigs)[owners]
    target = table.world_T_targets(world_T_rigs)[rows]
    target_R_host = np.einsum("rji,rjk->rik", target[:, :3, :3], host[:, :3, :3])
    c = np.einsum("rji,rj->ri", target[:, :3, :3], host[:, :3, 3] - target[:, :3, 3])
    spans = np.einsum("rij,rkj->rki", target_R_host, patch_axes(table.bearings_rig)[owners])
    return spans + planes[owners][:, :, None] * c[:, None, :]


def poor_views(
    table: PatchTable, world_T_rigs: np.ndarray, planes: np.ndarray
) -> dict[str, np.ndarray]:
    """Reason -> observations (O,) bool from which a patch cannot be aligned.

    "behind": a pixel of the patch has no positive depth; "grazing": the target sees the plane's
    back or along its surface; "zoom": far larger or smaller than in the host.
    """
    owners = table.owners
    inverse_depths = np.column_stack([np.ones(len(table.grid)), table.grid]) @ planes.T
    spans = patch_spans(table, world_T_rigs, planes, np.arange(len(owners)))
    middle = spans[:, 0]
    length = np.maximum(np.linalg.norm(middle, axis=1), 1e-12)
    # area of the patch on the target's sphere per area on the host's
    area = np.einsum("oi,oi->o", np.cross(spans[:, 1], spans[:, 2]), middle) / length**3
    normals = np.einsum("pk,pki->pi", planes, patch_axes(table.bearings_rig))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    hosts = table.world_T_hosts(world_T_rigs)[owners]
    normals = np.einsum("oij,oj->oi", hosts[:, :3, :3], normals[owners])
    rays = np.einsum("oij,oj->oi", table.world_T_targets(world_T_rigs)[:, :3, :3], middle)
    cosine = np.einsum("oi,oi->o", normals, rays) / length
    return {
        "behind": ~np.all(inverse_depths > 0, axis=0)[owners],
        "grazing": ~(cosine > 0.15),  # least cosine between a patch's normal and its viewing ray
        "zoom": ~((area < _MAX_ZOOM**2) & (area > _MAX_ZOOM**-2)),
    }


def pixels_of(bearings: np.ndarray, width: int) -> np.ndarray:
    """Equirectangular pixels (..., 2), (u, v), corner origin, of vectors (..., 3), rig frame."""
    x, y, z = bearings[..., 0], bearings[..., 1], bearings[..., 2]
    per_radian = width / (2 * np.pi)
    u = per_radian * np.arctan2(x, z) + width / 2
    return np.stack([u, per_radian * np.arctan2(y, np.hypot(x, z)) + width / 4], axis=-1)


def over_poles(image: np.ndarray, rows: int) -> np.ndarray:
    """An image (H, 2 H[, C]) continued by `rows` rows beyond either pole on the sphere."""
    half = image.shape[1] // 2
    above = np.roll(image[:rows][::-1], half, axis=1)
    below = np.roll(image[-rows:][::-1], half, axis=1)
    return np.concatenate([above, image, below], axis=0)


def coded(image: SphereImage) -> np.ndarray:
    """Spline coefficients in two bytes each, continued over seam and poles: (H + 2 PAD, 2 H + 2
    PAD) int16, steps of 1 / CODE_SCALE grey values from CODE_ZERO. ValueError: grey values are not
    finite."""
    tall = over_poles(image.coefficients, PAD)
    if not np.all(np.isfinite(tall)):
        raise ValueError("the grey values must be finite")
    wide = np.concatenate([tall[:, -PAD:], tall, tall[:, :PAD]], axis=1)
    steps = np.rint((wide - np.float32(CODE_ZERO)) * np.float32(CODE_SCALE))
    return np.clip(steps, -32768, 32767).astype(np.int16)


class PatchPixels:
    """Templates and windows of a table's patches, filled frame by frame.

    A window holds the patch under the given poses and `margin` pixels around: an observation that
    moves further is left out.
    """

    def __init__(
        self, table: PatchTable, world_T_rigs: np.ndarray, width: int, margin: float = 6.0
    ) -> None:
        """Allocate templates, of which nothing is sampled yet, for windows that poses (F, 4, 4)
        float64 place in sphere images of this width, with a margin in pixels of these at the
        equator. ValueError: the table is inconsistent, or does not fit the poses."""
        table.check(len(world_T_rigs))
        self.table, self.width, self.margin = table, width, margin
        self.templates = np.full((len(table), len(table.grid)), 0.0, dtype=np.float32)
        self.windows = np.zeros((len(table.targets), 4), dtype=np.int32)
        self.starts = np.zeros(len(table.targets), dtype=np.int64)
        self._world_T_rigs = world_T_rigs
        self._chunks: list[np.ndarray] = []
        self._length = 0

    @property
    def num_frames(self) -> int:
        """Number of poses given."""
        return len(self._world_T_rigs)

    def take(self, frame: int, image: SphereImage) -> None:
        """Cut templates and windows of frame `frame` out of its image."""
        width = image.coefficients.shape[1]
        if width != self.width:
            raise ValueError(f"image of {width} px where {self.width} px are expected")
        hosted = np.flatnonzero(self.table.hosts == frame)
        weights = np.column_stack([np.ones(len(self.table.grid)), self.table.grid])
        directions = weights @ patch_axes(self.table.bearings_rig[hosted])
        self.templates[hosted] = image.sample(directions)[0]
        rows = np.flatnonzero(self.table.targets == frame)
        if len(rows) == 0:
            return
        spans = patch_spans(self.table, self._world_T_rigs, self.table.planes, rows)
        uv = pixels_of(weights @ spans, self.width)
        height = self.width // 2
        u, v = uv[..., 0], uv[..., 1]
        u = u[:, :1] + (u - u[:, :1] + self.width / 2) % self.width - self.width / 2
        low = np.maximum(np.floor(v.min(axis=1) - self.margin) - PAD, -PAD)
        high = np.minimum(np.ceil(v.max(axis=1) + self.margin) + PAD, height + PAD)
        steepest = np.maximum(np.abs(low + PAD - height / 2), np.abs(high - PAD - height / 2))
        cosine = np.cos(np.minimum(np.pi / 2, np.pi * steepest / height))
        margin = self.margin / np.maximum(cosine, 1e-3)
        left = np.floor(u.min(axis=1) - margin) - PAD
        right = np.ceil(u.max(axis=1) + margin) + PAD
        ring = right - left >= self.width  # all around a pole
        left[ring], right[ring] = -PAD, self.width + PAD
        boxes = np.stack([left, low, right - left, high - low], axis=1).astype(np.int64)
        codes = coded(image)
        columns = np.arange(boxes[:, 2].max())
        for o, (left, top, wide, high) in zip(rows, boxes.tolist(), strict=True):
            first = left + PAD
            band = codes[top + PAD : top + PAD + high]
            if first >= 0 and first + wide <= codes.shape[1]:
                cut = band[:, first : first + wide]
            else:  # across the seam
                cut = band[:, PAD + (left + columns[:wide]) % self.width]
            self._chunks.append(cut.ravel())
            self.starts[o] = self._length
            self._length += cut.size
        self.windows[rows] = boxes

    def pixels(self) -> np.ndarray:
        """(M,) int16, all windows back to back in one array."""
        joined = np.concatenate([np.zeros(0, np.int16), *self._chunks])
        self._chunks = [joined]
        return joined
