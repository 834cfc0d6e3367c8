"""The prior of a run: the trajectory, and the parts of it that images confirm or contradict."""

from dataclasses import dataclass, replace

import numpy as np

from gsba.bundle.families import Family
from gsba.bundle.gauge import Gauge
from gsba.bundle.map_strength import MapStrength
from gsba.bundle.trajectory_prior import LOSS_SIGMAS, GyroTurns, TrajectoryPrior
from gsba.config import PriorSettings
from gsba.geometry import extent_of
from gsba.imu.alignment import Alignment
from gsba.loop_closure.merged_map import Registered
from gsba.trajectory.clock import ClockEstimate
from gsba.trajectory.joining import SegmentAlignment
from gsba.trajectory.judgement import StepChecks
from gsba.types import CoarsePoses, GyroConstraints, PoseSource, Solution


@dataclass(frozen=True, slots=True)
class Prior:
    """The trajectory with its checks by images; prior factors and the start follow from it."""

    coarse: CoarsePoses  # the trajectory at the frames' times
    trust: StepChecks  # steps that images confirm, and poses to start from
    clock: ClockEstimate | None = None  # None = not checked
    joints: tuple[SegmentAlignment, ...] = ()  # of pieces of the trajectory
    parts: np.ndarray | None = None  # (F,) int64, parts that nothing ties together; None = one
    merged: Registered | None = None  # parts of the map, joined; None = it never was in parts
    strength: MapStrength | None = None  # of the map, by images alone; None = not measured
    gyro: Alignment | None = None  # of the sensor that rides along; None = there is none
    turning: GyroConstraints | None = None  # its constraints on frames; None = images contradict it
    order_doubted: bool = False  # neighbours by the times given are hardly more alike than any two
    lone_steps: tuple[tuple[str, str], ...] = ()  # names of frames, see `pipeline.tour.check_order`
    of_recordings: tuple["Prior", ...] = ()  # of each of several recordings, before they were
    # combined: clocks and gyros of their own; () = there is one recording

    @classmethod
    def of(cls, coarse: CoarsePoses) -> "Prior":
        """The trajectory as it was read, with all steps confirmed."""
        return cls(coarse, StepChecks.of_all(coarse.world_T_rigs))

    @property
    def absent(self) -> bool:
        """Whether there is no trajectory."""
        return self.coarse.absent

    @property
    def unguided(self) -> np.ndarray:
        """Frames (F,) bool of recordings without a trajectory."""
        return self.coarse.sources == PoseSource.NONE

    @property
    def turning_only(self) -> bool:
        """Whether the camera stayed in one place, as its images say."""
        return self.trust.turning_only

    def weak_frames(self) -> np.ndarray:
        """Frames (F,) bool at which images hold the map poorly; none before that is measured."""
        none = np.zeros(len(self.coarse.sources), bool)
        return none if self.strength is None else self.strength.weak

    def start(self) -> Solution:
        """The trajectory, chained past its false steps, as a solution without points."""
        return Solution.without_points(self.trust.world_T_rigs)

    def families(
        self, settings: PriorSettings, first: np.ndarray | None = None
    ) -> tuple[Family, ...]:
        """The trajectory prior, as far as images confirm it, and the gyro's family if it has one;
        `first` (4, 4) is where the first pose is held, None = where the start has it."""
        trust, strength = self.trust, self.strength
        whole = trust.false_steps.all()  # then the start is all there is
        believed = trust.world_T_rigs if whole else self.coarse.world_T_rigs.copy()
        if self.merged is not None and not whole:
            believed[:, :3, 3] += self.merged.offsets
        false, noise = trust.false_steps, None
        if strength is not None:
            false, noise = false | strength.held_steps, strength.noise
        first = trust.world_T_rigs[0] if first is None else first
        prior = TrajectoryPrior(believed, settings, false, trust.false_frames, first, noise)
        if self.turning is None:
            return (prior,)
        extent = extent_of(believed[:, :3, 3])
        return prior, GyroTurns(self.turning, extent, LOSS_SIGMAS)

    def moved(self, gauge: Gauge) -> "Prior":
        """The trajectory carried to another world, part by part as numbered in `parts`."""
        coarse, trust, parts = self.coarse, self.trust, self.parts
        lengths = trust.lengths * gauge.scales(parts, len(coarse.sources))[:-1]
        start = gauge.poses(trust.world_T_rigs, parts)
        return replace(
            self,
            coarse=replace(coarse, world_T_rigs=gauge.poses(coarse.world_T_rigs, parts)),
            trust=replace(trust, world_T_rigs=start, lengths=lengths),
        )

    def worlds(self) -> CoarsePoses:
        """Coarse poses that define the worlds of the maps.

        Of several recordings, each map has the world and scale of its first recording that has a
        trajectory: poses of the others count as interpolated. The origin is that of the largest
        map's world, number 0.
        """
        coarse, num = self.coarse, len(self.coarse.sources)
        maps = np.zeros(num, np.int64) if self.parts is None else self.parts
        poses, defining = coarse.world_T_rigs.copy(), np.zeros(num, bool)
        origin = coarse.origin if maps[0] == 0 else None
        begin = 0
        for one in self.of_recordings:
            rows = begin + np.flatnonzero(one.coarse.sources == PoseSource.SLAM)
            if one.joints:  # further pieces of its trajectory have worlds of their own
                rows = rows[rows < begin + one.joints[0].first]
            for number in np.unique(maps[rows]).tolist():
                own = rows[maps[rows] == number]
                if len(own) >= 3 and not defining[maps == number].any():
                    poses[own], defining[own] = one.coarse.world_T_rigs[own - begin], True
                    origin = origin if number else one.coarse.origin
            begin += len(one.coarse.sources)
        others = np.isin(maps, maps[defining]) & ~defining
        sources = np.where(others, PoseSource.INTERPOLATED, coarse.sources).astype(np.uint8)
        return replace(coarse, world_T_rigs=poses, sources=sources, origin=origin)
