"""Sub-pixel sightings of a map's points in a new picture: patches of keyframes aligned to it."""

from dataclasses import dataclass

import numpy as np

from factors import tangent_basis
from factors.patches import expect
from factors.sphere_field import SphereField
from factors.sphere_image import SphereImage
from gsba.camera.lens import Lenses
from gsba.camera.projections import PerspectiveProjection
from gsba.features.detection import traits_of
from gsba.frames.panorama import Greys
from gsba.localization.photos import shows
from gsba.localization.run_map import RunMap, without_correction
from gsba.photometric.alignment import REJECTIONS, accepted_rows
from gsba.photometric.frame_jobs import align_to, cut
from gsba.photometric.references import MAX_ANGLE_DEG, MAX_RATIO, view_differences
from gsba.store.shards import Threads


@dataclass(frozen=True, slots=True)
class Expected:
    """Where a new picture should show points of the map, and the frames that lend their patches."""

    points: np.ndarray  # (N,) int64, numbers of points
    hosts: np.ndarray  # (N,) int64, frame of the map with the most similar view of each

    def shown_by(
        self, projection: PerspectiveProjection, world_T_camera: np.ndarray, map_: RunMap
    ) -> "Expected":
        """Those of the points that lie in a photo taken from a pose (4, 4)."""
        points = map_.result.points_world[self.points]
        shown = shows(projection, (points - world_T_camera[:3, 3]) @ world_T_camera[:3, :3])
        return Expected(self.points[shown], self.hosts[shown])


@dataclass(frozen=True, slots=True)
class AlignedPoints:
    """Points of the map where patches find them in a new picture."""

    points: np.ndarray  # (N,) int64, numbers of points
    bearings: np.ndarray  # (N, 3) unit, directions in the picture, as it shows them
    covariances: np.ndarray  # (N, 2, 2) radians^2, on the bearings' tangent_basis


class PatchAligner:
    """Aligns patches of a map's keyframes to new pictures."""

    def __init__(self, map_: RunMap) -> None:
        self._map, settings = map_, map_.settings.patches
        self.greys = Greys(without_correction(map_.frames), settings.max_width)

    @property
    def width(self) -> int:
        """Width of the panoramas that patches are aligned in, pixels."""
        return self.greys.width

    def expected(self, world_T_rig: np.ndarray, frames: np.ndarray) -> Expected:
        """Points that frames (N,) of the map observe, each with the frame whose view is most like
        that from a pose (4, 4)."""
        result = self._map.result
        rows = np.flatnonzero(np.isin(result.observation_frames, frames))
        points, hosts = result.observation_points[rows], result.observation_frames[rows]
        positions = result.points_world[points]
        own = positions - world_T_rig[:3, 3]
        theirs = positions - result.world_T_rigs[hosts, :3, 3]
        cosines, ratios, costs = view_differences(own, theirs)
        likely = cosines > np.cos(np.deg2rad(MAX_ANGLE_DEG))
        likely &= (ratios < MAX_RATIO) & (ratios * MAX_RATIO > 1)
        rows = np.flatnonzero(likely)
        rows = rows[np.lexsort((costs[rows], points[rows]))]
        _, first = np.unique(points[rows], return_index=True)
        rows = rows[first]
        return Expected(points[rows].astype(np.int64), hosts[rows].astype(np.int64))

    def align(
        self,
        expected: Expected,
        world_T_rig: np.ndarray,
        image: SphereImage,
        mask: np.ndarray | None,
        field: SphereField,
        lenses: Lenses,
    ) -> AlignedPoints:
        """Align the patches of expected points to a picture.

        Args:
            world_T_rig: (4, 4) predicted pose, within some pixels.
            image: the picture on the sphere, (width / 2, width).
            mask: (width / 2, width) bool, True = the picture shows it; None = all.
            field: of what stitching bends in the picture.
            lenses: of the picture; one centre by default.
        """
        map_ = self._map
        points = map_.result.points_world[expected.points]
        pixel, threads = 2 * np.pi / self.width, Threads(1)
        world_T_hosts = map_.result.world_T_rigs[expected.hosts]
        local = np.einsum("nji,nj->ni", world_T_hosts[:, :3, :3], points - world_T_hosts[:, :3, 3])
        if map_.cameras:
            local = map_.cameras.seeing(local, expected.hosts)
        depths = np.linalg.norm(local, axis=1)
        origins = map_.shown(local / np.maximum(depths, 1e-300)[:, None], expected.hosts)
        spreads = pixel * np.swapaxes(tangent_basis(origins), 1, 2)
        axes = world_T_hosts[:, :3, :3] @ spreads * depths[:, None, None]
        seen = (points - world_T_rig[:3, 3]) @ world_T_rig[:3, :3]
        if lenses:
            seen = lenses.seeing(seen, np.zeros(len(seen), np.int64))
        distances = np.maximum(np.linalg.norm(seen, axis=1), 1e-300)[:, None]
        at = field.observed(seen / distances)
        across = world_T_rig[:3, :3].T @ axes / distances[:, :, None]
        sightings = expect(np.arange(len(points)), at, across)
        size = traits_of(map_.settings).patch_size
        patches = cut("patches", self.greys, expected.hosts, origins, spreads, size, threads)
        align_to(image, mask, patches, sightings)
        dropped = dict.fromkeys(REJECTIONS, 0)
        found = accepted_rows(patches, np.ones(len(points)), sightings, pixel, dropped)
        kept, bearings, covariances = found
        return AlignedPoints(expected.points[kept], bearings, covariances)
