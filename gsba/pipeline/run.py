"""A run: inputs that no stage changes, storage of stages, and the journal for the report."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from gsba import learned
from gsba.bundle.families import Bearings, Families, Family, Reprojections
from gsba.bundle.trajectory_prior import GyroTurns, TrajectoryPrior
from gsba.camera.rig import CubeRig
from gsba.config import CameraSettings, RefineSettings
from gsba.frames import cubemap
from gsba.frames.panorama import Greys
from gsba.frames.recordings import own_timestamps
from gsba.imu.readings import Readings
from gsba.log import GsbaError
from gsba.parts import DividedAdjustments
from gsba.photometric import direct
from gsba.store.store import RunStore, fingerprint
from gsba.trajectory.limits import TwoViewLimits
from gsba.types import CoarsePoses, Counts, FrameSet, Round, RunStart, Trajectory

T = TypeVar("T")

_NOMINAL_DEG = 0.5  # that epipolar planes of neighbours are off, at least, while lenses of unknown
# make are taken for plain ones: 5 % of what pictures move by between them


@dataclass(frozen=True, slots=True)
class Journal:
    """Counts and rounds of stages, for the report alone."""

    counts: dict[str, list[Counts]] = field(default_factory=dict)  # by stage
    rounds: dict[str, tuple[Round, ...]] = field(default_factory=dict)  # of adjustment, by stage

    def note(self, name: str, result: object) -> None:
        """Note the counts and rounds that a stage's result has."""
        said = result[0] if isinstance(result, tuple) else result
        counts, rounds = getattr(said, "counts", None), getattr(said, "rounds", ())
        if isinstance(result, Counts):
            counts = result
        if counts is not None:
            self.counts[name] = [counts] if isinstance(counts, Counts) else list(counts)
        if rounds:
            self.rounds[name] = rounds


@dataclass(frozen=True, slots=True)
class RecordingEvidence:
    """Trajectory and gyro of one of several recordings, on the clock of that recording."""

    name: str  # of the recording
    coarse: CoarsePoses  # of its frames, in the trajectory's own world and unit
    trajectories: tuple[Trajectory, ...] = ()  # in pieces that each have their own world
    imu: Readings | None = None  # of a gyro that rode along; None = there are none
    camera: CameraSettings | None = None  # of its camera; None = those of the run
    start: RunStart = RunStart.TRAJECTORY  # for the report


@dataclass(frozen=True, slots=True)
class Evidence:
    """Inputs of a run beside its images."""

    trajectories: tuple[Trajectory, ...] = ()  # files, in pieces that each have their own world
    imu: Readings | None = None  # of a gyro that rode along; None = there are none
    families: tuple[Family, ...] = ()  # of GPS, of packages and of the caller
    recordings: tuple[RecordingEvidence, ...] = ()  # of several recordings, in order of their
    # frames, which then have their trajectories and gyros from here; () = there is one recording
    start: RunStart = RunStart.TRAJECTORY  # for the report
    blank: tuple[str, ...] = ()  # names of frames that are left out: see `unusable_frames`
    odd: tuple[str, ...] = ()

    @property
    def unusable(self) -> tuple[str, ...]:
        """Names of all frames that are left out."""
        return tuple(sorted((*self.blank, *self.odd)))

    def digests(self) -> list[object]:
        """Digests of the gyro's measurements and of the families of residuals."""
        families = [(family.name, family.digest) for family in self.families]
        return [None if self.imu is None else self.imu.digest, families]

    def start_name(self, absent: bool) -> str:
        """Name of the source of the initial poses, for the report."""
        if absent:
            return RunStart.PAIRS
        return " and ".join(dict.fromkeys(one.start for one in self.recordings)) or self.start


@dataclass(frozen=True, slots=True)
class Run:
    """Inputs, settings and store of a run, which no stage changes."""

    store: RunStore
    latest: list[str]  # names of the last stages, on which the next one rests
    journal: Journal
    frames: FrameSet  # as read, not straightened
    coarse: CoarsePoses  # start poses, as the trajectories say
    evidence: Evidence
    settings: RefineSettings
    rig: CubeRig  # faces that pixels of keypoints are given on: those of the first camera
    greys: Greys  # pictures for patches
    weights: Mapping[str, Path]  # stage -> file of a learned network
    num_threads: int
    families: Families  # those that observe points and those of the evidence, bound to the frames
    division: DividedAdjustments  # of large maps into parts
    lenses_found: tuple[
        bool, ...
    ] = ()  # (C,) whether the calibration that raw pairs are cut by was estimated by
    # a pass before, so that it is free
    suffix: str = ""  # of the names of stages that only see one of several recordings

    @classmethod
    def begin(
        cls,
        store: RunStore,
        frames: FrameSet,
        coarse: CoarsePoses,
        settings: RefineSettings,
        evidence: Evidence | None = None,
        journal: Journal | None = None,
        lenses_found: tuple[bool, ...] = (),
    ) -> "Run":
        """Start a run, or take it up, on these frames and poses. Raises GsbaError: frames that a
        chosen family cannot use, a family with a name of gsba's own, none that observes points, or
        weights that are not there."""
        direct.check(frames, settings)
        if settings.camera.model == "two_lens" and not all(
            kind.panoramic for kind in frames.formats
        ):
            raise GsbaError("camera.model = two_lens is for panoramas: cube faces hide the seam")
        evidence = evidence or Evidence()
        timed, rows = frames.timed_frames, frames.recordings
        sensors = [
            (evidence.imu, timed),
            *((one.imu, timed[rows[one.name]]) for one in evidence.recordings),
        ]
        if any(imu is not None and not own.all() for imu, own in sensors):
            raise GsbaError("--imu: nothing says when frames are from: pass --timestamps or --fps")
        rig = cubemap.rig_for(frames.formats[0], settings.cubemap)
        own: list[Family] = [Bearings(), Reprojections(rig)]
        own = [family for family in own if family.name in settings.factors]
        members = (*own, *evidence.families)
        families = Families(members, frames.names, frames.timestamps)
        for family in evidence.families:
            if family.name in (TrajectoryPrior.name, GyroTurns.name):
                raise GsbaError(f"family {family.name}: gsba has one of this name; rename yours")
        if not families.observing_points.members:
            raise GsbaError("factors: no family observes points; add bearing or reprojection")
        paths = [*(path for group in frames.paths for path in group), *frames.mask_paths]
        origins = [coarse.origin, *(one.coarse.origin for one in evidence.recordings)]
        origins = [origin if origin is None else origin.tolist() for origin in origins]
        start = coarse.world_T_rigs.tolist(), origins, settings.read
        timed_frames = frames.timed_of_frame or frames.timed
        timing = frames.timestamps.tolist(), frames.clock_shifts, timed_frames
        inputs = [fingerprint(paths), frames.names, *timing, *start]
        inputs += [frames.camera_of_frame, *map(asdict, frames.formats), lenses_found]
        store.stage("frames", inputs, lambda: frames, FrameSet)
        return cls(
            store=store,
            latest=["frames"],
            journal=journal or Journal(),
            frames=frames,
            coarse=coarse,
            evidence=evidence,
            settings=settings,
            rig=rig,
            greys=Greys(frames, settings.patches.max_width),
            weights=learned.find_weights(settings),
            num_threads=settings.solver.threads(),
            families=families,
            division=DividedAdjustments(
                store.parts_folder, store.shards_folder, store.workers, settings.solver.part_frames
            ),
            lenses_found=lenses_found,
        )

    def stage(
        self,
        name: str,
        key: object,
        compute: Callable[[], T],
        returns: type[T],
        *,
        noted: bool = True,
    ) -> T:
        """Result of a stage that rests on the one before it; `noted`: whether the report tells of
        it."""
        name += self.suffix
        result = self.store.stage(name, key, compute, returns, self.latest)
        self.latest[:] = [name]
        if noted:
            self.journal.note(name, result)
        return result

    def of_recording(self, number: int) -> "Run":
        """The run restricted to one of its recordings, on that recording's clock.

        Its stages rest on the latest one of this run.
        """
        given = self.evidence.recordings[number]
        frames = self.frames.taken(self.frames.recordings[given.name])
        times = own_timestamps(frames)
        return replace(
            self,
            latest=list(self.latest),
            frames=replace(frames, timestamps=times, clock_shifts=(0.0,) * len(times)),
            coarse=given.coarse,
            evidence=Evidence(given.trajectories, given.imu),
            families=replace(self.families.observing_points, names=frames.names, timestamps=times),
            suffix=f"@{given.name}",
        )

    @property
    def camera_settings(self) -> tuple[CameraSettings, ...]:
        """Settings (C,) of each of several cameras; () = there is one, with those of the run."""
        if len(self.frames.formats) == 1:
            return ()
        found, rows = [self.settings.camera] * len(self.frames.formats), self.frames.recordings
        for one in reversed(self.evidence.recordings):
            if one.camera is not None:
                found[self.frames.cameras[rows[one.name][0]]] = one.camera
        return tuple(found)

    def is_timed(self, camera: int) -> bool:
        """True if timestamps of all frames that a camera took are times."""
        return bool(self.frames.timed_frames[self.frames.cameras == camera].all())

    def settings_of(self, camera: int) -> CameraSettings:
        """Settings of one camera."""
        found = self.camera_settings
        return found[camera] if found else self.settings.camera

    @property
    def matching_settings(self) -> RefineSettings:
        """Settings whose gates are as wide as directions of raw pairs are uncertain."""
        own, widest = TwoViewLimits.of(self.settings).max_error_deg, 1.0
        for kind in self.frames.formats:
            if kind.fisheyes is not None:
                focal = min(lens.focal for lens in kind.fisheyes)
                pixels = 2.0 if kind.lenses_nominal else 1.0
                least = max(float(np.rad2deg(pixels / focal)), _NOMINAL_DEG * kind.lenses_nominal)
                widest = max(widest, least / own)
        return self.settings if widest == 1.0 else self.settings.with_gates(widest)

    def matching_key(self) -> list[object]:
        """Settings that matches rest on."""
        settings = self.matching_settings
        files = fingerprint(path for stage, path in self.weights.items() if stage == "matching")
        how = settings.matching.matcher, settings.features.extractor, files
        return [settings.pairs, settings.gate_factor, how, settings.seed]

    def solving_key(self) -> list[object]:
        """Settings that solutions rest on."""
        settings = self.settings
        relevant = [settings.rounds, settings.priors, settings.solver]
        return [*relevant, self.families.digests()]
