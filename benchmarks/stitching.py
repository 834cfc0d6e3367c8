"""Effect of a stitching field on held-out points.

    python -m benchmarks.stitching FRAMES TRAJECTORY --out WORK [--masks FILE] [--markdown FILE]

A fifth of the points is held out. Poses are estimated from the other points: by bearings of
features alone, by aligned patches, and by aligned patches with a field. Held-out points are aligned
once, under the last of these, and measured under each: they are triangulated again, which gives
reprojection errors, and the pixels of two views of a patch are compared at their projected
positions, after gain and offset (grey). The last row is the lower bound, with patches at their
aligned positions (noise, JPEG, surfaces that are not planar remain); "over" is the mean excess of
pairs of views over it.
"""

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.common import write_table
from factors import tangent_basis
from factors.sphere_field import SphereField
from factors.sphere_image import SphereImage
from gsba import refine
from gsba.bundle import adjustment, stitching, triangulation
from gsba.bundle.bearings import Bearings
from gsba.bundle.families import Families
from gsba.bundle.shared_parameters import of_points
from gsba.bundle.trajectory_prior import TrajectoryPrior
from gsba.config import RefineSettings
from gsba.frames import cubemap, panorama
from gsba.geometry import angular_errors
from gsba.photometric import alignment
from gsba.store.shards import Threads
from gsba.store.store import load_stage
from gsba.types import FrameSet, Keypoints, Landmarks, Sighted, Solution, Tracks

SHARE = 0.2  # of points held out
GATE = 1e3  # sigmas: no held-out observation is left out by its own residual
REACH = 5  # pixels from the middle of a patch to its edge


@dataclass(frozen=True, slots=True)
class Variant:
    """Poses with their stitching field."""

    name: str
    solved: Solution
    field: SphereField


def split(landmarks: Landmarks, seed: int) -> tuple[Landmarks, Landmarks]:
    """Points for the solve, and held-out points."""
    held = np.random.default_rng(seed).random(landmarks.tracks.num_points) < SHARE
    return of_points(landmarks, ~held), of_points(landmarks, held)


def solve(run: Path, frames: FrameSet, settings: RefineSettings) -> tuple[list[Variant], Sighted]:
    """Variants from the other points, and held-out points aligned under the last variant."""
    keypoints = load_stage(run, "keypoints", Keypoints)
    start, rig = (
        load_stage(run, "refined1", Solution),
        cubemap.rig_for(frames.format, settings.cubemap),
    )
    greys = panorama.Greys(frames, settings.patches.max_width)
    priors = TrajectoryPrior(start.world_T_rigs, settings.priors)
    used, held = split(start.landmarks, settings.seed)
    none, threads, workers = SphereField.none(), 2, Threads(2)
    problem = adjustment.AdjustmentContext(Families((Bearings(), priors)), rig, settings, threads)

    bearing = adjustment.adjust(
        used.tracks, keypoints, start, problem, settings.rounds.refined[-1:]
    )
    variants = [Variant("bearing", bearing, none)]
    for name, uses_field in (("aligned", False), ("aligned, field", True)):
        solved, observed, aligned, field = bearing, keypoints, None, none
        for number in (1, 2):
            sighted = alignment.align(
                solved,
                alignment.Observations(observed, aligned, field=field),
                greys,
                rig,
                settings.patches,
                workers,
                name=f"{name} {number}",
            )
            there = replace(sighted, keypoints=stitching.corrected(sighted.keypoints, field, rig))
            solved, found = adjustment.adjust_sighted(
                there, solved, problem, settings.rounds.aligned
            )
            observed = stitching.with_noise_of(sighted.keypoints, found)
            aligned = sighted.aligned
            if uses_field:
                result = stitching.estimate(sighted, observed, solved, field, problem)
                solved, observed, field = result.adjustment, result.keypoints, result.field
                print(
                    f"parts gain {result.part_gains.round(3)}, degree {result.degree}", flush=True
                )
        variants.append(Variant(name, solved, field))
    last = variants[-1]
    placed = place(last, held.tracks, keypoints, settings)
    solved = replace(last.solved, landmarks=placed, noise=start.noise)
    observed = alignment.Observations(keypoints, field=last.field)
    sighted = alignment.align(
        solved, observed, greys, rig, settings.patches, workers, name="held out"
    )
    return variants, sighted


def place(
    variant: Variant, tracks: Tracks, keypoints: Keypoints, settings: RefineSettings
) -> Landmarks:
    """Points triangulated under a variant's poses."""
    rows = keypoints.rows(tracks)
    bearings = variant.field.corrected(keypoints.bearings_rig[rows])
    given = keypoints.sigmas_rad[rows], variant.solved.world_T_rigs, GATE, settings.triangulate
    return triangulation.triangulate(tracks, bearings, *given, 2)


def reprojections(variant: Variant, landmarks: Landmarks, keypoints: Keypoints) -> np.ndarray:
    """Angles (O,) of observations to their points, radians."""
    tracks, rows = landmarks.tracks, keypoints.rows(landmarks.tracks)
    return angular_errors(
        variant.solved.world_T_rigs[tracks.frames],
        landmarks.points_world[tracks.points],
        variant.field.corrected(keypoints.bearings_rig[rows]),
    )


def grey_differences(
    variant: Variant,
    landmarks: Landmarks,
    images: list[SphereImage],
    aligned: Keypoints | None = None,
) -> np.ndarray:
    """RMS differences (N,) of patches in successive views, grey values.

    With `aligned`, patches are sampled at their observed positions, else at the projected ones.
    """
    tracks, poses = landmarks.tracks, variant.solved.world_T_rigs
    places = None if aligned is None else aligned.bearings_rig[aligned.rows(tracks)]
    first = np.flatnonzero(np.diff(tracks.points) == 0)  # consecutive observations of a point
    steps = np.arange(-REACH, REACH + 1)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2) * images[0].pixel_rad
    out = np.empty(len(first))
    for i, row in enumerate(first):
        point, seen = landmarks.points_world[tracks.points[row]], []
        for k in (row, row + 1):
            pose = poses[tracks.frames[k]]
            local = (point - pose[:3, 3]) @ pose[:3, :3]
            if k == row:
                depth, axes = np.linalg.norm(local), tangent_basis(local / np.linalg.norm(local))
                patch = (local + depth * grid @ axes) @ pose[:3, :3].T + pose[:3, 3]
            rays = (patch - pose[:3, 3]) @ pose[:3, :3]
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
            rays = variant.field.observed(rays)
            if places is not None:
                rays += places[k] - rays[len(rays) // 2]
                rays /= np.linalg.norm(rays, axis=1, keepdims=True)
            seen.append(images[tracks.frames[k]].sample(rays)[0])
        a, b = seen[0] - seen[0].mean(), seen[1] - seen[1].mean()
        gain = np.sqrt(np.sum(a * a) / max(np.sum(b * b), 1e-12))
        out[i] = np.sqrt(np.mean((a - gain * b) ** 2))
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("frames", type=Path)
    parser.add_argument("trajectory", type=Path)
    parser.add_argument("--masks", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    settings = RefineSettings.model_validate(
        {"patches": {"rounds": 0}, "export": {"formats": ()}, "stitching": {"mode": "auto"}}
    )
    result = refine(options.frames, options.trajectory, options.out, settings, masks=options.masks)
    settings = RefineSettings()
    variants, sighted = solve(options.out, result.frames, settings)
    greys = panorama.Greys(result.frames, settings.patches.max_width)
    images = [SphereImage.of(greys[f][0]) for f in range(len(result.frames))]
    pixel = np.degrees(images[0].pixel_rad)
    lines = [
        f"{options.frames.parent.name}: {sighted.tracks.num_points} held-out points, "
        f"{len(sighted.tracks)} observations; panoramas {greys.width} wide.\n",
        "| poses from | field rms ° | reprojection px, median | 90% | grey, median | mean | over |",
        "|---|---|---|---|---|---|---|",
    ]
    placed = place(variants[-1], sighted.tracks, sighted.keypoints, settings)
    least = grey_differences(variants[-1], placed, images, sighted.keypoints)
    for variant in variants:
        placed = place(variant, sighted.tracks, sighted.keypoints, settings)
        angles = np.degrees(reprojections(variant, placed, sighted.keypoints)) / pixel
        grey = grey_differences(variant, placed, images)
        lines.append(
            f"| {variant.name} | {np.degrees(variant.field.rms_rad):.3f} | {np.median(angles):.3f} "
            f"| {np.percentile(angles, 90):.3f} | {np.median(grey):.2f} | {np.mean(grey):.2f} "
            f"| {np.mean(grey - least):.2f} |"
        )
        print(lines[-1], flush=True)
    lines.append(f"| where aligned | | | | {np.median(least):.2f} | {np.mean(least):.2f} | 0 |")
    write_table(lines, options.markdown)


if __name__ == "__main__":
    main()
