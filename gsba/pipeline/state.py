"""The state of a run between two stages: a stage takes one, and gives the one after it."""

from dataclasses import dataclass, replace

import numpy as np

from gsba.bundle import triangulation
from gsba.bundle.adjustment import AdjustmentContext
from gsba.bundle.families import Families
from gsba.bundle.readout import CameraEstimates
from gsba.camera.cameras import Cameras
from gsba.camera.lens import Lenses
from gsba.config import PriorSettings
from gsba.loop_closure import connectivity
from gsba.matching.guided_search import MatchContext
from gsba.pipeline.map import Map
from gsba.pipeline.prior import Prior
from gsba.pipeline.run import Run
from gsba.store.store import PerFrame
from gsba.types import Features, Keypoints, Landmarks, Matches, Solution, Tracks, VerifiedPairs


@dataclass(frozen=True, slots=True)
class ObservedFrames:
    """Keypoints of all frames, and the means to match them."""

    features: tuple[PerFrame[Features], ...]  # (F,) stage that holds each frame's
    shown: Keypoints  # of all frames, where pictures show them
    context: MatchContext  # matches them
    more: bool = False  # whether all frames got as many keypoints as weak ones from the start

    @property
    def keypoints(self) -> Keypoints:
        """Of all frames, as rays of the cameras."""
        return self.context.keypoints

    @property
    def cameras(self) -> Cameras:
        """Cameras that the keypoints are seen through."""
        return self.context.cameras

    def through(self, cameras: Cameras) -> "ObservedFrames":
        """The frames with their keypoints as rays that start at the lenses of these cameras."""
        context = replace(self.context, keypoints=cameras.seen(self.shown), cameras=cameras)
        return replace(self, context=context)


@dataclass(frozen=True, slots=True)
class MapMatches:
    """Keypoint matches that tracks of the map are made of."""

    neighbours: Matches  # of frames next to one another in time
    known_points: Matches | None = None  # of points of the map, in frames further apart
    across: Matches | None = None  # of frames of parts of the map that were joined
    loops: Matches | None = None  # of frames that met the same place again

    def sets(self) -> list[Matches]:
        """The sets that there are, in the order in which tracks are built."""
        every = self.neighbours, self.known_points, self.across, self.loops
        return [matches for matches in every if matches is not None]

    def within(self, parts: np.ndarray) -> "MapMatches":
        """Matches of neighbours and of known points whose frames are in one part (F,)."""
        known = self.known_points
        return replace(
            self,
            neighbours=connectivity.within(self.neighbours, parts),
            known_points=None if known is None else connectivity.within(known, parts),
        )


@dataclass(frozen=True, slots=True)
class State:
    """All that a stage may read of a run: the inputs, and the results of the stages before it."""

    run: Run  # inputs, settings and the store: no stage changes them
    prior: Prior  # the trajectory, as far as images confirm it, and the gyro
    observed: ObservedFrames  # keypoints, as rays of the lenses that features have shown so far
    map: Map  # poses, points and camera; at the start the poses of the trajectory
    verified: VerifiedPairs  # neighbours in time with their relative poses
    matches: MapMatches  # that the map is made of
    places: Matches | None = None  # of a tour, searched along epipolar lines; None = not searched

    @classmethod
    def begin(cls, run: Run, observed: ObservedFrames) -> "State":
        """The state before the first match, with the trajectory as it was read as the prior."""
        prior, none = Prior.of(run.coarse), VerifiedPairs.none()
        start = Map.of(prior.start(), observed.shown, run.frames)
        return cls(run, prior, observed, start, none, MapMatches(none.matches))

    @property
    def solution(self) -> Solution:
        """Poses and points of the map."""
        return self.map.solution

    def start_from(self, prior: Prior) -> "State":
        """The state with another prior, its map the poses that this prior starts from."""
        return replace(
            self, prior=prior, map=Map.of(prior.start(), self.observed.shown, self.run.frames)
        )

    def begun(self, prior: Prior, near: VerifiedPairs) -> "State":
        """The state before its map: another prior, in the parts that these matches of neighbours
        and the trajectory tie together."""
        parts = connectivity.parted(near.matches.pairs, prior.trust.held_steps)
        return self.start_from(replace(prior, parts=parts)).with_verified(near)

    def with_verified(self, verified: VerifiedPairs) -> "State":
        """The state with other matches of neighbours, and none beside these."""
        return replace(self, verified=verified, matches=MapMatches(verified.matches))

    def with_solution(self, solution: Solution) -> "State":
        """The state with other poses and points."""
        return replace(self, map=replace(self.map, solution=solution))

    def with_cameras(self, found: CameraEstimates) -> "State":
        """The state with other cameras of the map; keypoints stay rays of those before."""
        return replace(self, map=self.map.with_cameras(found))

    def with_lenses(self, camera: int, lenses: Lenses) -> "State":
        """The state with other lenses of one camera of the map; keypoints stay as they are."""
        found = self.map.estimates()
        return self.with_cameras(found.changed(camera, replace(found.each[camera], lenses=lenses)))

    def through(self, cameras: Cameras) -> "State":
        """The state with its keypoints as rays of these cameras; the map's cameras stay."""
        return replace(self, observed=self.observed.through(cameras))

    def maps_of_images(self) -> np.ndarray:
        """Map (F,) of each frame, as images tie frames together, not the trajectory; -1 = of too
        few frames."""
        merged = self.prior.merged
        maps = connectivity.maps_of_images(self.verified.matches.pairs, len(self.run.frames))
        if merged is not None:
            maps[merged.met] = len(maps) + merged.components[merged.met]
        return maps

    def triangulated(self, tracks: Tracks, keypoints: Keypoints, gate: float) -> Landmarks:
        """Points of tracks under the poses as they are; `gate` in the keypoints' standard
        deviations."""
        poses, run = self.solution.world_T_rigs, self.run
        return triangulation.place(tracks, keypoints, poses, gate, run.num_threads)

    def adjustment_context(self) -> AdjustmentContext:
        """Families and settings of an adjustment of this map."""
        run, prior = self.run, self.prior
        guided = any(not family.observes_points for family in run.families.members)
        first = self.solution.world_T_rigs[0] if guided else None
        own = prior.families(run.settings.priors, first)
        families = run.families.with_members((*own, *run.families.members))
        return self._context(families.fitted(self.solution, prior.parts))

    def context_of_images(self, noise: PriorSettings) -> AdjustmentContext:
        """The context of an adjustment by images, trajectory and gyro alone."""
        observing = self.run.families.observing_points
        own = self.prior.families(noise)
        return self._context(observing.with_members((*own, *observing.members)))

    def _context(self, families: Families) -> AdjustmentContext:
        run, settings = self.run, self.run.settings
        if not run.frames.timed:
            settings = settings.model_copy(update={"camera": settings.camera.untimed()})
        return AdjustmentContext(
            families=families,
            rig=run.rig,
            settings=settings,
            num_threads=run.num_threads,
            maps=self.prior.parts,
            cameras=tuple(
                camera if run.is_timed(number) else camera.untimed()
                for number, camera in enumerate(run.camera_settings)
            ),
            division=run.division,
            scratch=run.store.scratch_folder,
        )
