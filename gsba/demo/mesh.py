"""Builder of meshes of textured faces for the ray caster. World: x right, y down, z forward."""

from collections.abc import Sequence

import cv2
import numpy as np

from gsba.demo.light import bake
from gsba.demo.raycast import Scene

Vector = Sequence[float] | np.ndarray
DOWN = np.array([0.0, 1.0, 0.0])


class MeshBuilder:
    """Collects faces and textures; `build` makes the Scene."""

    def __init__(self, seed: int = 0) -> None:
        self._rng = np.random.default_rng(seed)
        self._images: list[np.ndarray] = []
        self._scales: list[float] = []
        self._corners: list[np.ndarray] = []
        self._edges: list[np.ndarray] = []
        self._spans: list[float] = []
        self._textures: list[int] = []
        self._windows: list[np.ndarray] = []
        self._emissions: list[float] = []

    def texture(self, image: np.ndarray, texels_per_unit: float = 0.0) -> int:
        """Add an image (H, W, 3) uint8 RGB; returns its handle.

        Args:
            image: the texture.
            texels_per_unit: faces show a window of this resolution, at a random position if the
                texture is larger than the face; 0 stretches the whole image over each face.
        """
        self._images.append(image)
        self._scales.append(texels_per_unit)
        return len(self._images) - 1

    def face(
        self,
        corner: np.ndarray,
        edge_a: np.ndarray,
        edge_b: np.ndarray,
        texture: int,
        emission: float = 0.0,
        triangle: bool = False,
    ) -> None:
        """Add a parallelogram or triangle; seen from its front, edge_a is right, edge_b down."""
        height, width = self._images[texture].shape[:2]
        extent = np.array([width, height], dtype=np.float64)
        if self._scales[texture] > 0:
            edges = np.array([np.linalg.norm(edge_a), np.linalg.norm(edge_b)])
            extent = np.minimum(edges * self._scales[texture], extent)
        start = self._rng.uniform(0, np.array([width, height]) - extent + 1e-9)
        self._corners.append(np.asarray(corner, dtype=np.float64))
        self._edges.append(np.stack([edge_a, edge_b]).astype(np.float64))
        self._spans.append(1.0 if triangle else 2.0)
        self._textures.append(texture)
        self._windows.append(np.concatenate([start, extent]))
        self._emissions.append(emission)

    def panel(
        self,
        center: Vector,
        facing: Vector,
        size: tuple[float, float],
        texture: int,
        emission: float = 0.0,
    ) -> None:
        """Add an upright rectangle around `center` whose front faces along the horizontal `facing`.

        Args:
            center: (3,) middle of the rectangle.
            facing: (3,) horizontal direction.
            size: width and height in units.
        """
        right = np.cross(DOWN, -np.asarray(facing, dtype=np.float64))
        edge_a, edge_b = size[0] * right / np.linalg.norm(right), size[1] * DOWN
        self.face(np.asarray(center) - edge_a / 2 - edge_b / 2, edge_a, edge_b, texture, emission)

    def level(
        self, x: tuple[float, float], z: tuple[float, float], y: float, texture: int, up: bool,
        emission: float = 0.0,
    ) -> None:  # fmt: skip
        """Add a horizontal rectangle over x and z at y, its front up (floor) or down (ceiling)."""
        edge_a = np.array([x[1] - x[0], 0, 0])
        edge_b = np.array([0, 0, (z[0] - z[1]) if up else (z[1] - z[0])])
        corner = np.array([x[0], y, z[1] if up else z[0]])
        self.face(corner, edge_a, edge_b, texture, emission)

    def box(
        self,
        x: tuple[float, float],
        z: tuple[float, float],
        heights: tuple[float, float],
        sides: int,
        top: int | None = None,
    ) -> None:
        """Add an upright box between two heights above the floor y = 0 (texture handles)."""
        top = sides if top is None else top
        center = np.array([sum(x) / 2, -sum(heights) / 2, sum(z) / 2])
        half = np.array([x[1] - x[0], heights[1] - heights[0], z[1] - z[0]]) / 2
        for axis, across in ((0, 2), (2, 0)):
            for sign in (-1, 1):
                facing = sign * np.eye(3)[axis]
                size = (2 * half[across], 2 * half[1])
                self.panel(center + facing * half, facing, size, sides)
        self.level(x, z, -heights[1], top, up=True)
        if heights[0] > 0:
            self.level(x, z, -heights[0], top, up=False)

    def column(
        self, x: float, z: float, radius: float, heights: tuple[float, float], texture: int
    ) -> None:
        """Add an upright prism of 20 sides without caps."""
        num_sides = 20
        width = 2 * radius * np.tan(np.pi / num_sides)
        for angle in 2 * np.pi * np.arange(num_sides) / num_sides:
            facing = np.array([np.cos(angle), 0, np.sin(angle)])
            center = radius * facing + [x, -sum(heights) / 2, z]
            self.panel(center, facing, (width * 1.001, heights[1] - heights[0]), texture)

    def boulder(self, center: Vector, radius: float, texture: int) -> None:
        """Add a faceted stone: a subdivided octahedron with random radii."""
        vertices, triangles = _sphere(2)
        radii = radius * (1 + 0.22 * np.clip(self._rng.standard_normal(len(vertices)), -2, 1))
        vertices = np.asarray(center) + vertices * radii[:, None]
        for p, q, r in vertices[triangles]:
            self.face(p, r - p, q - p, texture, triangle=True)

    def build(self) -> Scene:
        """Build the scene: hierarchy of the faces, filtered textures, baked light."""
        corners, edges = np.array(self._corners), np.array(self._edges)
        order, nodes = _hierarchy(corners, edges)
        corners, edges = corners[order], edges[order]
        normals = np.cross(edges[:, 1], edges[:, 0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        texels, levels = _pyramids(self._images)
        # light is sampled every 0.3 units
        grid = np.ceil(np.linalg.norm(edges, axis=2) / 0.3).astype(np.int64) + 1
        counts = grid[:, 0] * grid[:, 1]
        scene = Scene(
            corners=corners,
            edges=edges,
            duals=np.linalg.pinv(np.swapaxes(edges, 1, 2)),
            normals=normals,
            spans=np.array(self._spans)[order],
            textures=np.array(self._textures)[order],
            windows=np.array(self._windows)[order],
            emissions=np.array(self._emissions)[order],
            **nodes,
            texels=texels,
            levels=levels,
            albedos=np.array([image.mean(axis=(0, 1)) / 255 for image in self._images]),
            light_grids=np.column_stack([np.cumsum(counts) - counts, grid]),
            light=np.ones((counts.sum(), 3)),
        )
        return scene._replace(light=bake(scene)) if scene.emissions.any() else scene


def _sphere(subdivisions: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (N, 3) on the unit sphere and outward triangles (M, 3) of a split octahedron."""
    vertices = [np.array(v, float) for v in np.concatenate([np.eye(3), -np.eye(3)])]
    triangles = [
        (sx, sy, sz) if (sx < 3) ^ (sy < 3) ^ (sz < 3) else (sx, sz, sy)
        for sx in (0, 3) for sy in (1, 4) for sz in (2, 5)
    ]  # fmt: skip
    for _ in range(subdivisions):
        middle: dict[tuple[int, int], int] = {}

        def split(i: int, j: int, middle: dict[tuple[int, int], int] = middle) -> int:
            key = (min(i, j), max(i, j))
            if key not in middle:
                point = vertices[i] + vertices[j]
                vertices.append(point / np.linalg.norm(point))
                middle[key] = len(vertices) - 1
            return middle[key]

        finer = []
        for i, j, k in triangles:
            ij, jk, ki = split(i, j), split(j, k), split(k, i)
            finer += [(i, ij, ki), (ij, j, jk), (ki, jk, k), (ij, jk, ki)]
        triangles = finer
    return np.array(vertices), np.array(triangles)


def _hierarchy(corners: np.ndarray, edges: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Face order (Q,) and the nodes of Scene, split by the surface area heuristic."""
    far = corners + edges.sum(axis=1)
    spanned = np.stack([corners, corners + edges[:, 0], corners + edges[:, 1], far])
    low, high = spanned.min(axis=0) - 1e-7, spanned.max(axis=0) + 1e-7
    order: list[int] = []
    nodes: list[list] = []  # low, high, skip, face

    def add(faces: np.ndarray) -> None:
        node = [low[faces].min(axis=0), high[faces].max(axis=0), 0, -1]
        nodes.append(node)
        if len(faces) == 1:
            node[3] = len(order)
            order.append(int(faces[0]))
        else:
            for part in _split(faces, low, high):
                add(part)
        node[2] = len(nodes)

    add(np.arange(len(corners)))
    names = ("node_low", "node_high", "node_skip", "node_face")
    columns = (np.array(column) for column in zip(*nodes, strict=True))
    return np.array(order), dict(zip(names, columns, strict=True))


def _split(faces: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split a set of boxes into two with the smallest sum of surface area times number."""

    def costs(ranked: np.ndarray) -> np.ndarray:
        size = np.maximum.accumulate(high[ranked]) - np.minimum.accumulate(low[ranked])
        area = size[:, 0] * size[:, 1] + size[:, 1] * size[:, 2] + size[:, 2] * size[:, 0]
        return area * np.arange(1, len(ranked) + 1)

    best = (np.inf, faces, faces)
    for axis in range(3):
        ranked = faces[np.argsort((low + high)[faces, axis], kind="stable")]
        total = costs(ranked)[:-1] + costs(ranked[::-1])[-2::-1]
        at = int(np.argmin(total))
        if total[at] < best[0]:
            best = (float(total[at]), ranked[: at + 1], ranked[at + 1 :])
    return best[1], best[2]


def _pyramids(images: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Texels (T, 3) uint8 and levels (num_textures, num_levels, 3) of box-filtered pyramids.

    Images are padded to a multiple of the coarsest texel by repeating the border, so that texel
    (i, j) of level k covers exactly 2^k x 2^k texels of level 0.
    """
    num_levels = 8
    block = 2 ** (num_levels - 1)
    texels, levels, offset = [], [], 0
    for image in images:
        height, width = image.shape[:2]
        bottom, right = -height % block, -width % block
        fine = cv2.copyMakeBorder(image, 0, bottom, 0, right, cv2.BORDER_REPLICATE)
        for k in range(num_levels):
            size = fine.shape[1] >> k, fine.shape[0] >> k
            level = cv2.resize(fine, size, interpolation=cv2.INTER_AREA)
            texels.append(level.reshape(-1, 3))
            levels.append((offset, *size))
            offset += size[0] * size[1]
    return np.concatenate(texels), np.array(levels).reshape(len(images), num_levels, 3)
