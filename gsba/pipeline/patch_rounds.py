"""Rounds of patch alignment: patches aligned, camera and poses adjusted, stitching removed."""

import logging
from collections.abc import Sequence
from dataclasses import replace

from gsba.bundle import adjustment, map_strength, readout, stitching
from gsba.bundle.reconstruction import MIN_OBSERVATIONS
from gsba.bundle.stitching import Stitching
from gsba.features.detection import traits_of
from gsba.photometric import alignment
from gsba.photometric.alignment import AlignedObservations
from gsba.pipeline import camera, frontend
from gsba.pipeline.state import State
from gsba.types import Keypoints, Sighted, Solution

logger = logging.getLogger(__name__)


def align(state: State) -> State:
    """Align patches and adjust in rounds, until steps move by less than their noise."""
    before, rounds = state, state.run.settings.patches.rounds
    for n in range(1, rounds + 1):
        if is_settled(before, state, n):
            return state
        if n > 1:
            state = frontend.align_gyro_to_map(state, f"imu_aligned{n}")
        before, state = state, _round(state, n)
    if rounds > 2 and not is_settled(before, state, rounds + 1):
        logger.warning("poses still moved in the last of %d rounds of patch alignment", rounds)
    return state


def _round(state: State, number: int) -> State:
    """Patches aligned to frames, solved, straightened; the map as it was where that is worse."""
    sighted = observe(state, state.solution, observations(state), f"align{number}")
    better = _adjust_under_lenses(state, sighted, number)
    if better is None:
        return state
    # Alignments of the gyro to camera estimates within a round are let go: `align` makes the next
    # one from the poses of the whole round.
    state = replace(better, prior=state.prior)
    run, map_, settings = state.run, state.map, state.run.settings
    looked_for = number == 1 or map_.field
    stitched = len(run.frames.formats) == 1 and run.frames.format.layout in ("erp", "eac")
    if settings.stitching.mode == "off" or not stitched or not looked_for:
        return state

    def compute() -> Stitching:
        context, solution = state.adjustment_context(), map_.solution
        return stitching.estimate(
            sighted, map_.observed, solution, map_.field, context, map_.lenses
        )

    key = [run.solving_key(), settings.stitching]
    found = run.stage(f"stitching{number}", key, compute, Stitching)
    if not found.field:
        return replace(state, map=replace(map_, stitching=found))
    if not found.adjustment.carries(map_.solution, MIN_OBSERVATIONS):
        return state
    if map_.stitching is not None:  # its gain is measured against no field
        found = replace(found, part_gains=map_.stitching.part_gains)
    map_ = replace(map_, solution=found.adjustment, observed=found.keypoints, stitching=found)
    return replace(state, map=map_)


def _adjust_under_lenses(state: State, sighted: Sighted, number: int) -> State | None:
    """Bundle adjustment of aligned observations, the camera found from them beside it."""
    name = f"aligned{number}"
    if not state.map.lenses:
        # Later rounds begin at poses of the one before, whose outliers are known.
        gates = adjustment.ALIGNED_GATES if number == 1 else adjustment.ALIGNED_GATES[-1:]
        last = number > 1 or state.run.settings.patches.rounds == 1
        return adjust_aligned(state, sighted, name, gates, final=last)
    for n in range(2):
        state = frontend.align_gyro_to_map(state, f"imu_{name}_{n}", with_noise=False)
        trial = camera.take_parts_from_patches(state, sighted, name, n)
        if n and trial.map.lenses.parts == state.map.lenses.parts:
            return trial
        stage = f"{name}_{n}" if n else name
        solved, keypoints, found = camera.adjust_with_patches(trial, sighted, stage)
        kept = found.with_each([readout.without_vanished(one) for one in found.each])
        if any(one is not other for one, other in zip(kept.each, found.each, strict=True)):
            trial, stage = trial.with_cameras(kept), f"{name}_instant"
            solved, keypoints, found = camera.adjust_with_patches(trial, sighted, stage)
        better = carried(trial, sighted, solved, keypoints)
        if better is None:
            return state if n else None
        state = better.with_cameras(found)
    return state


def observe(state: State, start: Solution, observed: AlignedObservations, name: str) -> Sighted:
    """Points of a solution observed anew, by aligned patches."""
    run, settings = state.run, state.run.settings.patches

    def compute() -> Sighted:
        given = run.greys, run.rig, run.store.workers, state.map.lenses, name
        return alignment.align(start, observed, *given)

    return run.stage(name, settings.model_dump(exclude={"rounds"}), compute, Sighted)


def observations(state: State) -> AlignedObservations:
    """Observations of the map's points."""
    map_, folder = state.map, state.run.store.scratch_folder
    size = traits_of(state.run.settings).patch_size
    return AlignedObservations(
        map_.observed, size, map_.aligned, map_.normals_rig, map_.field, folder
    )


def adjust_aligned(
    state: State,
    sighted: Sighted,
    name: str,
    gates: Sequence[float] | None = None,
    *,
    final: bool = True,
) -> State | None:
    """Bundle adjustment of aligned observations; None where that explains less. `final`: solve it
    to the end."""
    run, map_ = state.run, state.map
    gates = adjustment.ALIGNED_GATES if gates is None else gates

    def compute() -> tuple[Solution, Keypoints]:
        there = replace(sighted, keypoints=map_.rays(sighted.keypoints, run.rig))
        context = state.adjustment_context()
        solved, found = adjustment.adjust_sighted(there, map_.solution, context, gates, final)
        return solved, stitching.with_noise_of(sighted.keypoints, found, context.scratch)

    key = [run.solving_key(), gates, final]
    solved, keypoints = run.stage(name, key, compute, tuple[Solution, Keypoints])
    return carried(state, sighted, solved, keypoints)


def carried(state: State, sighted: Sighted, solved: Solution, keypoints: Keypoints) -> State | None:
    """The state with the map of aligned observations; None where that explains less."""
    if not solved.carries(state.solution, MIN_OBSERVATIONS):
        return None
    map_ = replace(
        state.map,
        solution=solved,
        observed=keypoints,
        aligned=sighted.aligned,
        normals_rig=sighted.normals_rig,
    )
    return replace(state, map=map_)


def is_settled(before: State, state: State, number: int) -> bool:
    """True if the last round (`number` is the next) moved steps by less than their noise."""
    # rounds of patches that face their hosts, and of patches that lie on their surfaces
    if number <= 2:
        return False
    run, prior, solution = state.run, state.prior, state.solution

    def compute() -> float:
        keypoints, context = state.map.keypoints(run.rig), state.adjustment_context()
        covariances, joint = adjustment.pose_covariances(solution, keypoints, context, prior.parts)
        former = before.solution.world_T_rigs
        poses = former, solution.world_T_rigs
        moved = map_strength.step_motion(*poses, covariances, joint, prior.parts)
        logger.debug("aligned %d times, steps moved by %.2f sigma", number - 1, moved)
        return moved

    moved = run.stage(f"settled_aligned{number}", run.solving_key(), compute, float)
    return not moved > 1.0
