"""The stages of one run that solve for its poses, on top of those that match its frames."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from factors.sphere_field import SphereField
from gsba.bundle import adjustment, common_errors, map_strength, stitching, tracks, triangulation
from gsba.bundle.map_strength import MapStrength
from gsba.bundle.reconstruction import assemble
from gsba.bundle.stitching import Stitching
from gsba.log import GsbaError
from gsba.loop_closure import connectivity, map_merging
from gsba.loop_closure.merged_map import Registered, follow
from gsba.photometric import alignment, direct
from gsba.photometric.direct import PhotometricResult
from gsba.pipeline.frontend import MatchingStages
from gsba.splat import refinement
from gsba.splat.refinement import SplatResult
from gsba.store.store import digest
from gsba.types import (
    FrameSet,
    Keypoints,
    Matches,
    Reconstruction,
    Sighted,
    Solution,
    Tracks,
    VerifiedPairs,
)


class Line(MatchingStages):
    """One run: its inputs, its features, and a method for each stage after them."""

    def register(
        self, neighbours: VerifiedPairs, solved: Solution, matches: list[Matches]
    ) -> tuple[Solution, list[Matches]]:
        """Parts of the map joined where they meet, frames in none of them registered.

        Raises:
            GsbaError: there is no map at all, so that nothing could be registered against it.
        """
        if not len(solved.landmarks.points_world):
            raise GsbaError(
                "no scene point is seen from enough frames, with enough parallax: frames must "
                "follow one another closely (or lower triangulate.min_track_length or "
                "triangulate.min_parallax_deg)"
            )
        least, trust = self.settings.rounds.min_observations, self.trust
        if trust is None:
            return solved, matches
        nothing, scarce = np.zeros_like(trust.held_steps), connectivity.starving(solved, least)
        tied = connectivity.parted(neighbours.matches.pairs, nothing, scarce)
        if tied is None:
            return solved, matches
        given = self.context, solved, tied, trust.held_steps, ~trust.unseen_steps
        compute = partial(map_merging.merge, *given, self.frames.timestamps)
        found = self._stage("registered", self._matching(), compute, Registered)
        self.counts["registered"] = [found.counts]
        self.registered, self.parts = found, connectivity.several(found.components)
        self.coarse, self.trust, self.joints = follow(found, self.coarse, trust, self.joints)
        self._set_priors()
        adjacent = self.match_along_epipolars(found.solved, "adjacent2")
        return found.solved, [adjacent, *(connectivity.within(m, tied) for m in matches[1:])]

    def look_closer(self, solved: Solution, adjacent: Matches) -> tuple[Solution, Matches]:
        """What images hold well goes without priors; more keypoints where they hold it poorly."""
        closer, trust = self.settings.closer, self.trust
        if trust is None:
            return solved, adjacent
        steps = ~trust.unseen_steps, ~trust.false_steps
        faint = self.settings.priors.faint()

        def compute() -> MapStrength:
            given = self._priors(faint), self.keypoints, self.rig, self.settings, self.num_threads
            known = adjustment.pose_covariances(solved, *given, self.parts)
            coarse, how = self.coarse.world_T_rigs, (closer, self.settings.priors, self.parts)
            return map_strength.measure(solved.world_T_rigs, *known, coarse, *steps, *how)

        found = self._stage("strength", [self._solving(), closer], compute, MapStrength)
        self.counts["strength"], self.strength = [found.counts], found
        self._set_priors()
        if closer.mode == "off" or not found.weak.any():
            return solved, adjacent
        self.extract_more(found.weak)
        adjacent = self.match_along_epipolars(solved, "adjacent_closer")
        placed = self._place("placed_closer", [adjacent], solved)
        wide = self.match_known_points("wide_closer", placed, loops_closed=True)
        gates = self.settings.rounds.dense
        return self.solve("dense_closer", [adjacent, wide], placed, gates), adjacent

    def _place(self, name: str, matches: Sequence[Matches], solved: Solution) -> Solution:
        """Points of these matches under poses as they are."""
        settings = self.settings

        def compute() -> Solution:
            found = self._tracks(matches)
            rows, gate = self.keypoints.rows(found), settings.rounds.dense[-1] * solved.noise
            seen = self.keypoints.bearings_rig[rows], self.keypoints.sigmas_rad[rows]
            how = gate, settings.triangulate, self.num_threads
            return replace(
                solved, landmarks=triangulation.triangulate(found, *seen, solved.world_T_rigs, *how)
            )

        return self._stage(name, [self._solving()], compute, Solution)

    def _tracks(self, matches: Sequence[Matches]) -> Tracks:
        """Tracks that matches make, within parts that nothing ties together yet."""
        tied = [connectivity.within(some, self.parts) for some in matches]
        return tracks.build(tied, np.diff(self.keypoints.starts))

    def solve(
        self,
        name: str,
        matches: Sequence[Matches],
        start: Solution,
        gates: Sequence[float],
        final: bool = False,
    ) -> Solution:
        """Bundle adjustment in rounds over the tracks that matches make."""

        def compute() -> Solution:
            given = self._tracks(matches), self.keypoints, start, self.priors, self.rig
            return adjustment.adjust(*given, gates, self.settings, self.num_threads, final)

        solved = self._stage(name, [self._solving(), gates, final], compute, Solution)
        self.counts[name] = [solved.landmarks.counts]
        self.solutions[name] = solved
        return solved

    def align(self, number: int, solved: Solution) -> Sighted:
        """Points observed anew by aligning patches."""
        name = f"align{number}"

        def compute() -> Sighted:
            given = solved.landmarks, solved.world_T_rigs, self.observed, solved.noise
            how = name, self.aligned, self.settings.align, self.num_threads, self.field
            return alignment.align(*given, self.greys, self.rig, *how)

        key = self.settings.align.model_dump(exclude={"rounds"})
        sighted = self._stage(name, key, compute, Sighted)
        self.counts[name] = [sighted.counts]
        return sighted

    def solve_aligned(self, number: int, sighted: Sighted, before: Solution) -> Solution:
        """Bundle adjustment of aligned observations; undone where that explains less."""
        name, gates = f"aligned{number}", self.settings.rounds.aligned

        def compute() -> tuple[Solution, Keypoints]:
            there = replace(sighted, keypoints=self._corrected(sighted.keypoints))
            given = self.priors, self.rig, gates, self.settings, self.num_threads
            solved, found = adjustment.run_sighted(there, before, *given)
            return solved, stitching.with_noise_of(sighted.keypoints, found)

        key = [self._solving(), gates]
        solved, keypoints = self._stage(name, key, compute, tuple[Solution, Keypoints])
        self.counts[name] = [solved.landmarks.counts]
        self.solutions[name] = solved
        if not solved.carries(before, self.settings.rounds.min_observations):
            self.undone.append(name)
            return before
        self.observed, self.aligned = keypoints, sighted.aligned
        return solved

    def straighten(self, number: int, sighted: Sighted, solved: Solution) -> Solution:
        """The map with what stitching bends taken out, where all frames share it."""
        name, settings = f"stitching{number}", self.settings
        is_first, is_off = number == 1, settings.stitching.mode == "off"
        undone = self.solutions[f"aligned{number}"] is not solved
        if is_off or undone or not self.frames.panoramic or not (is_first or self.field):
            return solved

        def compute() -> Stitching:
            given = sighted, self.observed, solved, self.field, self.priors, self.rig
            return stitching.estimate(*given, settings, self.num_threads)

        key = [self._solving(), settings.stitching, settings.rounds.aligned]
        found = self._stage(name, key, compute, Stitching)
        self.counts[name] = [found.counts]
        if not found.field:
            self.stitching = found
            return solved
        self.solutions[name] = found.adjustment
        if not found.adjustment.carries(solved, settings.rounds.min_observations):
            self.undone.append(name)
            return solved
        if self.stitching is not None:  # what it gained is known best from where none was
            found = replace(found, part_gains=self.stitching.part_gains)
        self.stitching, self.observed = found, found.keypoints
        return found.adjustment

    @property
    def field(self) -> SphereField:
        """What is known of what stitching bends."""
        return SphereField.none() if self.stitching is None else self.stitching.field

    @property
    def corrected(self) -> FrameSet:
        """The frames, read as the field straightens them."""
        return replace(self.frames, correction=tuple(self.field.coefficients.tolist()))

    def _corrected(self, keypoints: Keypoints) -> Keypoints:
        return stitching.corrected(keypoints, self.field, self.rig)

    def solve_photometric(self, solved: Solution) -> Solution:
        """Joint refinement by the observations so far and the grey values of patches."""
        name, settings = "photometric", self.settings

        def compute() -> PhotometricResult:
            observed = self._corrected(self.observed)
            given = self.corrected, observed, solved, self.priors, self.rig
            return direct.refine(*given, settings, self.num_threads)

        key = [self._solving(), settings.photometric]
        result = self._stage(name, key, compute, PhotometricResult)
        self.counts[name], self.solutions[name] = list(result.counts), result.adjustment
        self.frame_weights = result.frame_weights
        return result.adjustment

    def refine_on_splat(self, solved: Solution) -> Solution:
        """Joint refinement by the observations so far, patches, and a splat of the frames."""
        name, settings = "splat", self.settings
        key = [self._solving(), settings.splat, settings.photometric, settings.factors]
        turns = self.store.root / "stages" / name / "turns.npz"

        def compute() -> SplatResult:
            further = direct.joint(
                self.corrected, solved, self.frame_weights, settings, self.num_threads
            )
            observed = self._corrected(self.observed)
            given = self.corrected, observed, solved, self.priors, self.rig, settings
            start = digest(key, solved.world_T_rigs.tolist())
            return refinement.refine(*given, self.num_threads, further, turns, start)

        result = self._stage(name, key, compute, SplatResult)
        turns.unlink(missing_ok=True)
        self.counts[name], self.solutions[name] = list(result.counts), result.adjustment
        self.moves = result.moves
        return result.adjustment

    def reconstruct(self, solved: Solution) -> Reconstruction:
        """Covariances, and everything back in the trajectory's world."""

        def compute() -> Reconstruction:
            observed, least = self._corrected(self.observed), self.settings.rounds.min_observations
            given = self.priors, observed, self.rig, self.settings, self.num_threads
            claimed = adjustment.pose_covariances(solved, *given, self.parts)
            covariances, joint = common_errors.added(*claimed, solved.world_T_rigs, self.parts)
            false = None if self.trust is None else self.trust.false_frames
            last = self.corrected.correction, self.parts, joint
            return assemble(solved, covariances, observed, self.coarse, least, false, *last)

        return self._stage("reconstruction", self._solving(), compute, Reconstruction)

    def _solving(self) -> list[object]:
        settings = self.settings
        relevant = [settings.triangulate, settings.rounds, settings.priors, settings.solver]
        return [
            *relevant,
            [f for f in settings.factors if f not in ("photometric", "splat")],
            self.custom,
        ]
