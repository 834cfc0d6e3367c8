"""A run: what no stage changes, how a stage is kept, and the journal that the report reads."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np

from gsba import learned
from gsba.bundle import gps_factors
from gsba.bundle.adjustment import AdjustmentContext
from gsba.bundle.families import Families, Family
from gsba.bundle.fixes import FrameFixes
from gsba.camera.rig import CubeRig
from gsba.config import PriorSettings, RefineSettings
from gsba.frames import cubemap
from gsba.frames.panorama import Greys
from gsba.imu.readings import Readings
from gsba.log import GsbaError
from gsba.photometric import direct
from gsba.pipeline.prior import Prior
from gsba.store.store import Chain, RunStore, fingerprint
from gsba.types import CoarsePoses, Counts, FrameSet, Round, Solution

T = TypeVar("T")

_NOMINAL_DEG = 0.5  # that epipolar planes of neighbours are off, at least, while lenses of unknown
# make are taken for plain ones: 5 % of what pictures move by between them
_NOMINAL_PIXELS = 2.0  # the same, pixels


@dataclass(frozen=True, slots=True)
class Journal:
    """What stages received, kept and decided; the report reads it, nothing that computes does."""

    counts: dict[str, list[Counts]] = field(default_factory=dict)  # by stage
    rounds: dict[str, tuple[Round, ...]] = field(default_factory=dict)  # of adjustment, by stage

    def note(self, name: str, result: object) -> None:
        """Write down what a stage's result says of itself."""
        said = result[0] if isinstance(result, tuple) else result
        counts, rounds = getattr(said, "counts", None), getattr(said, "rounds", ())
        if isinstance(result, Counts):
            counts = result
        if counts is not None:
            self.counts[name] = [counts] if isinstance(counts, Counts) else list(counts)
        if rounds:
            self.rounds[name] = rounds


@dataclass(frozen=True, slots=True)
class Run:
    """What no stage changes."""

    store: RunStore
    chain: Chain  # of stages, each resting on the one before
    journal: Journal
    frames: FrameSet  # as read, not straightened
    settings: RefineSettings
    rig: CubeRig  # faces that keypoints are found on
    greys: Greys  # pictures for patches
    weights: Mapping[str, Path]  # stage -> file of a learned network
    num_threads: int
    lenses_found: bool = False  # whether what raw pairs are cut by was found, so that it is free
    imu: Readings | None = None  # of a gyro that rode along; None = there are none
    fixes: FrameFixes | None = None  # of frames by GPS, for its factors; None = there are none
    families: Families = field(default_factory=Families)  # of the caller, or of packages

    @classmethod
    def begin(
        cls,
        store: RunStore,
        frames: FrameSet,
        coarse: CoarsePoses,
        settings: RefineSettings,
        journal: Journal | None = None,
        lenses_found: bool = False,
        imu: Readings | None = None,
        fixes: FrameFixes | None = None,
        families: Sequence[Family] = (),
    ) -> "Run":
        """Start a run, or take it up, on these frames and poses.

        Raises:
            GsbaError: frames that a chosen family cannot use, or weights that are not there.
        """
        direct.check(frames, settings)
        if settings.camera.model == "two_lens" and not frames.panoramic:
            raise GsbaError("camera.model = two_lens is for panoramas: cube faces hide the seam")
        if imu is not None and not frames.timed:
            raise GsbaError("--imu: nothing says when frames are from: pass --timestamps or --fps")
        chain = Chain(store)
        paths = [*(path for group in frames.paths for path in group), *frames.mask_paths]
        start = coarse.world_T_rigs.tolist(), settings.read
        inputs = [fingerprint(paths), frames.timestamps.tolist(), frames.timed, *start]
        if frames.fisheyes is not None:
            inputs += [*map(asdict, frames.fisheyes), lenses_found, frames.lenses_nominal]
        chain.stage("frames", inputs, lambda: frames, FrameSet)
        return cls(
            store=store,
            chain=chain,
            journal=journal or Journal(),
            frames=frames,
            settings=settings,
            rig=cubemap.rig_for(frames, settings.cubemap),
            greys=Greys(frames, settings.patches.max_width),
            weights=learned.find_weights(settings),
            num_threads=settings.solver.threads(),
            lenses_found=lenses_found,
            imu=imu,
            fixes=fixes,
            families=Families(tuple(families), frames.names, frames.timestamps),
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
        """Result of a stage that rests on the one before it: the stored one, or computed.

        Args:
            name, key, compute, returns: see `gsba.store.RunStore.stage`.
            noted: whether the report tells of it.
        """
        result = self.chain.stage(name, key, compute, returns)
        if noted:
            self.journal.note(name, result)
        return result

    def problem(
        self, prior: Prior, solved: Solution | None, noise: PriorSettings | None = None
    ) -> AdjustmentContext:
        """What adjustments share while this is believed of the trajectory.

        Args:
            solved: poses so far, that GPS fixes are carried to; None = without GPS and families.
            noise: of the trajectory; None = as in the settings.
        """
        settings, noise = self.settings, noise or self.settings.priors
        anchors, first, ungauged = None, None, None
        families = Families() if solved is None else self.families
        freed = bool(families.fixing_gauge.members)
        if self.fixes is not None and solved is not None:
            poses = solved.world_T_rigs
            first = poses[0]
            anchors = gps_factors.anchor(poses, self.fixes, settings.gps, prior.parts)
            freed |= anchors is not None and anchors.holds(0, prior.parts)
        if solved is not None and (freed or anchors is not None):
            ungauged = prior.graph(noise, solved.world_T_rigs[0], gauge=not freed)
        graph = prior.graph(noise, first)
        settings = settings if self.frames.timed else settings.untimed()
        given = graph, self.rig, settings, self.num_threads, prior.turning
        return AdjustmentContext(*given, anchors, ungauged, families, prior.parts)

    @property
    def matching_settings(self) -> RefineSettings:
        """Settings whose gates are as wide as directions of raw pairs are uncertain."""
        frames, own = self.frames, self.settings.verify.max_error_deg
        if frames.fisheyes is None:
            return self.settings
        focal = min(lens.focal for lens in frames.fisheyes)
        pixels = _NOMINAL_PIXELS if frames.lenses_nominal else 1.0
        least = max(float(np.rad2deg(pixels / focal)), _NOMINAL_DEG * frames.lenses_nominal)
        return self.settings.with_gates(max(1.0, least / own))

    def matching_key(self) -> list[object]:
        """Settings that matches rest on."""
        settings = self.matching_settings
        files = fingerprint(path for stage, path in self.weights.items() if stage == "matching")
        how = settings.matching.model_dump(exclude={"weights"}), files
        return [settings.pairs, how, settings.verify, settings.seed]

    def solving_key(self) -> list[object]:
        """Settings that solutions rest on."""
        settings = self.settings
        relevant = [settings.triangulate, settings.rounds, settings.priors, settings.solver]
        families = [f for f in settings.factors if f not in ("photometric", "splat")]
        known = []
        if self.fixes is not None:
            known = [settings.gps.loss_sigmas, self.fixes.digest()]
        return [*relevant, families, self.families.digests(), *known]
