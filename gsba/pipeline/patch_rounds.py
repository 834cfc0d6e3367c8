"""Rounds of a run below a pixel: patches aligned, camera and poses solved by them, straightened."""

import logging
from dataclasses import replace

from gsba.bundle import (
    adjustment,
    lens_axes,
    readout,
    self_calibration,
    settling,
    stitching,
    triangulation,
)
from gsba.bundle.camera_adjustment import solve_sighted_with_camera
from gsba.bundle.lens_axes import LensAxes
from gsba.bundle.readout import CameraEstimate
from gsba.bundle.self_calibration import SelfCalibration
from gsba.bundle.stitching import Stitching
from gsba.photometric import alignment
from gsba.pipeline import backend
from gsba.pipeline.map import Map
from gsba.pipeline.prior import Prior
from gsba.pipeline.run import Run
from gsba.types import Keypoints, Sighted, Solution

logger = logging.getLogger(__name__)

_SETTLED = 1.0  # standard deviations of steps: poses that a round moves by less are left there


def align(run: Run, prior: Prior, world: Map) -> tuple[Prior, Map]:
    """Rounds of patches aligned and the map solved anew: more where images hold it poorly."""
    settings, before = run.settings.patches, world
    most = settings.rounds
    if most and prior.weak_frames().any():
        most = max(most, settings.weak_rounds)
    for n in range(1, most + 1):
        if n > settings.rounds and _is_settled(run, prior, before, world, n):
            break
        if n > 1:
            prior = backend.align_imu(run, prior, world.solution, f"imu_aligned{n}")
        before, world = world, _round(run, prior, world, n)
    return prior, world


def _round(run: Run, prior: Prior, world: Map, number: int) -> Map:
    """Patches around the map's points aligned to its frames, solved, straightened.

    The map stays as it was where that explains less.
    """
    sighted = _align(run, world, f"align{number}")
    better = _adjust_under_lenses(run, prior, world, sighted, number)
    if better is None:
        return world
    return _straighten(run, prior, better, sighted, number)


def _adjust_under_lenses(
    run: Run, prior: Prior, world: Map, sighted: Sighted, number: int
) -> Map | None:
    """Bundle adjustment of aligned observations, the camera found from them beside it."""
    name = f"aligned{number}"
    if not world.lenses:
        return _adjust_aligned(run, prior, world, sighted, name)
    for n in range(2):
        prior = backend.align_imu(run, prior, world.solution, f"imu_{name}_{n}", with_noise=False)
        seen = _take_parts(run, prior, world, sighted, name, n)
        if n and seen.lenses.parts == world.lenses.parts:
            return seen
        better = _adjust_with_camera(run, prior, seen, sighted, f"{name}_{n}" if n else name)
        if better is None:
            return world if n else None
        world = better
    return world


def _align(run: Run, world: Map, name: str) -> Sighted:
    """Points observed anew."""
    settings, solved = run.settings.patches, world.solution

    def compute() -> Sighted:
        return alignment.align(
            solved.landmarks,
            solved.world_T_rigs,
            world.observed,
            solved.noise,
            run.greys,
            run.rig,
            name,
            world.aligned,
            settings,
            run.store.workers,
            world.field,
            world.lenses,
            world.normals_rig,
        )

    return run.stage(name, settings.model_dump(exclude={"rounds"}), compute, Sighted)


def _take_parts(
    run: Run, prior: Prior, world: Map, sighted: Sighted, name: str, number: int
) -> Map:
    """The map with the parts of a camera that aligned patches turn out to show: how rows are read,
    then, once that was solved for, raw lenses and axes. Poses are yet to follow."""

    def placed_anew() -> tuple[Solution, Keypoints]:
        there = replace(sighted, keypoints=world.rays(sighted.keypoints, run.rig))
        there = adjustment.rescale_noise(there, world.solution, run.settings)
        placed = triangulation.place(
            there.tracks,
            there.keypoints,
            world.solution.world_T_rigs,
            run.settings.rounds.aligned[0],
            run.settings.triangulate,
            run.num_threads,
        )
        return replace(world.solution, noise=1.0, landmarks=placed), there.keypoints

    def axes() -> LensAxes:
        solved, keypoints = placed_anew()
        problem = run.problem(prior, solved)
        return lens_axes.loosened(solved.landmarks, keypoints, solved, world.lenses, problem)

    shown = stitching.corrected(sighted.keypoints, world.field, run.rig).bearings_rig
    times = run.frames.timestamps

    def rows() -> CameraEstimate:
        solved, keypoints = placed_anew()
        around, problem = solved.landmarks, run.problem(prior, solved)
        return readout.estimate(around, keypoints, shown, solved, world.lenses, times, problem)

    def lenses() -> SelfCalibration:
        solved, keypoints = placed_anew()
        around, problem = solved.landmarks, run.problem(prior, solved)
        given = around, keypoints, shown, solved, world.lenses, problem
        return self_calibration.estimate(*given, run.frames.lenses_nominal)

    key = backend.camera_key(run)
    if number == 0 and world.lenses.readout_motion is None:
        world = world.with_camera(run.stage(f"readout_{name}", key, rows, CameraEstimate))
    raw = run.frames.fisheyes is not None
    if number == 1 and raw and world.lenses.fisheyes is None:  # the rest has settled
        known = run.stage(f"calibrated_{name}", key, lenses, SelfCalibration)
        world = replace(world, calibrated=known)
        world = world.with_camera(replace(world.camera(), lenses=known.lenses))
    if number == 1 and not run.frames.lens_axes_known and world.lenses.axes is None:
        found = run.stage(f"axes_{name}", key, axes, LensAxes)
        world = replace(world, axes=found).with_camera(replace(world.camera(), lenses=found.lenses))
    return world


def _adjust_with_camera(
    run: Run, prior: Prior, world: Map, sighted: Sighted, name: str
) -> Map | None:
    """Aligned observations solved for poses and camera; None where that explains less."""
    gates = run.settings.rounds.aligned

    def compute() -> tuple[Solution, Keypoints, CameraEstimate]:
        shown = stitching.corrected(sighted.keypoints, world.field, run.rig)
        there, before = replace(sighted, keypoints=shown), world.solution
        problem, times = run.problem(prior, before), run.frames.timestamps
        given = there, world.camera(), times, before, problem, gates
        solved, found, camera = solve_sighted_with_camera(*given)
        return solved, stitching.with_noise_of(sighted.keypoints, found), camera

    key, returns = [*backend.camera_key(run), gates], tuple[Solution, Keypoints, CameraEstimate]
    solved, keypoints, camera = run.stage(name, key, compute, returns)
    better = _carried(run, world, sighted, solved, keypoints)
    return None if better is None else better.with_camera(camera)


def _adjust_aligned(run: Run, prior: Prior, world: Map, sighted: Sighted, name: str) -> Map | None:
    """Bundle adjustment of aligned observations; None where that explains less."""
    gates = run.settings.rounds.aligned

    def compute() -> tuple[Solution, Keypoints]:
        there = replace(sighted, keypoints=world.rays(sighted.keypoints, run.rig))
        problem = run.problem(prior, world.solution)
        solved, found = adjustment.adjust_sighted(there, world.solution, problem, gates)
        return solved, stitching.with_noise_of(sighted.keypoints, found)

    key = [run.solving_key(), gates]
    solved, keypoints = run.stage(name, key, compute, tuple[Solution, Keypoints])
    return _carried(run, world, sighted, solved, keypoints)


def _carried(
    run: Run, world: Map, sighted: Sighted, solved: Solution, keypoints: Keypoints
) -> Map | None:
    """The map of aligned observations; None where that explains less."""
    if not solved.carries(world.solution, run.settings.rounds.min_observations):
        return None
    shown = {"aligned": sighted.aligned, "normals_rig": sighted.normals_rig}
    return replace(world, solution=solved, observed=keypoints, **shown)


def _straighten(run: Run, prior: Prior, world: Map, sighted: Sighted, number: int) -> Map:
    """The map with what stitching bends taken out, where all frames share it."""
    name, settings = f"stitching{number}", run.settings
    looked_for = number == 1 or world.field
    stitched = run.frames.layout in ("erp", "eac")
    if settings.stitching.mode == "off" or not stitched or not looked_for:
        return world

    def compute() -> Stitching:
        return stitching.estimate(
            sighted,
            world.observed,
            world.solution,
            world.field,
            run.problem(prior, world.solution),
            world.lenses,
        )

    key = [run.solving_key(), settings.stitching, settings.rounds.aligned]
    found = run.stage(name, key, compute, Stitching)
    if not found.field:
        return replace(world, stitching=found)
    if not found.adjustment.carries(world.solution, settings.rounds.min_observations):
        return world
    if world.stitching is not None:  # what it gained is known best from where none was
        found = replace(found, part_gains=world.stitching.part_gains)
    return replace(world, solution=found.adjustment, observed=found.keypoints, stitching=found)


def _is_settled(run: Run, prior: Prior, before: Map, world: Map, number: int) -> bool:
    """Whether the last round of aligning patches moved steps by less than their noise."""

    def compute() -> float:
        solved, problem = world.solution, run.problem(prior, world.solution)
        known = adjustment.pose_covariances(solved, world.keypoints(run.rig), problem, prior.parts)
        former = before.solution.world_T_rigs
        return settling.step_motion(former, solved.world_T_rigs, *known)

    moved = run.stage(f"settled_aligned{number}", run.solving_key(), compute, float)
    logger.info("aligned %d times, steps moved by %.2f sigma", number - 1, moved)
    return not moved > _SETTLED
