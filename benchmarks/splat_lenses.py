"""Splats of a camera with two lenses: faces of one lens each beside faces of stitched panoramas.

    python -m benchmarks.splat_lenses --out WORK [--seeds 0 1 2] [--markdown FILE]

For each seed a walk through the demo's gallery with the two-lens camera is refined with and without
its camera model. Splats are trained on the CPU, with each frame equally often:

- `lenses`, on ten faces of one lens each, like `gsba train`;
- `middle`, with the same poses on the same ten views of the panoramas, all of one centre;
- `stitched`, with these poses on six faces of the panoramas;
- `central`, on six faces with the poses of the model with one centre.

Ten views take more steps than six larger ones: `longer` is `stitched` with as many steps as
`lenses`, `shorter` is `lenses` with as many as `stitched`.

Whole frames are held out. They are scored twice, each splat rendered at its own poses:

- on pixels of the lenses: ten views without the blended band at the seam. A splat of lenses is
  rendered from either lens, and the motion during the readout is corrected in the images, like in
  training. A splat of one centre is rendered from that, in the directions that these pixels have in
  the panorama.
- on exact renderings of the gallery from the middle between the lenses at the true pose, six faces
  of one centre, without noise; with the best gain of each channel, because each frame has its own
  exposure.

Runs and splats are kept in WORK and resumed. The exit code is 1 if `lenses` is worse on the first.
"""

import argparse
import sys
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.common import machine
from gsba.camera.optics import ONE_EYE, Optics
from gsba.camera.rig import CubeRig
from gsba.camera.views import rig_views
from gsba.config import CameraSettings, ExportSettings, RefineSettings, SplatSettings
from gsba.demo import make_walk
from gsba.demo.gallery import build_gallery
from gsba.demo.render import render_erp
from gsba.disk import write_text
from gsba.evaluate.splats import PosedViews, train_and_measure
from gsba.frames.cubemap import cut
from gsba.log import GsbaError, show_log
from gsba.pipeline.refine import refine
from gsba.splat.backend import choose_backend
from gsba.splat.scene import Faces, load_faces, make_views, near_of, refined_frames, split_frames
from gsba.splat.scores import Score, mean_score, measure
from gsba.store.finished import load_cameras, load_run
from gsba.store.store import digest
from gsba.trajectory.files import read_trajectory

WIDTH, FINE = 1024, 2048  # pixels across the walk's panoramas, and across exact ones
ROWS = ("lenses", "middle", "stitched", "central", "longer", "shorter")
_ALMOST = 1e-9  # factor on the distance between the lenses, which puts both in the middle


def refined(walk: Path, out: Path, model: str) -> Path:
    """Finished run of a walk with a camera model."""
    camera = CameraSettings.model_validate({"model": model})
    settings = RefineSettings(camera=camera, export=ExportSettings(formats=()))
    refine(walk / "images", walk / "slam.tum", out, settings)
    return out


def one_eye_between(optics: Optics) -> Optics:
    """Optics with the same views, all from the middle, without correction of the readout."""
    lenses = optics.lenses
    middle = replace(
        lenses, centre=_ALMOST * lenses.centre, inverse_stitch_radius=0.0, readout_motion=None
    )
    return Optics(middle)


def exact_faces(walk: Path, which: np.ndarray, size: int) -> Faces:
    """Exact renderings of an ideal camera at the true poses of some frames."""
    scene, rig = build_gallery(), CubeRig(size, np.pi / 2)
    truth, images = read_trajectory(walk / "groundtruth.tum").world_T_rigs, []
    for f in which:
        erp = np.clip(render_erp(scene, truth[f], FINE, FINE // 2) + 0.5, 0, 255)
        images += list(cut(erp.astype(np.uint8), rig))
    return Faces(rig_views(rig), images, [np.ones((size, size), bool) for _ in images])


def run_seed(
    seed: int, out: Path, settings: SplatSettings, rows: tuple[str, ...], threads: int
) -> dict[str, tuple[Score, Score]]:
    """Scores on the lenses' pixels and on exact ones, by row."""
    walk = out / f"walk{seed}"
    if not walk.exists():
        make_walk(walk, "rectangle", "forward", width=WIDTH, seed=seed, camera="two-lens")
    runs = {name: refined(walk, out / f"run{seed}-{name}", name) for name in ("auto", "central")}
    reconstruction, frames = load_run(runs["auto"])
    lenses = load_cameras(runs["auto"], reconstruction, frames)
    if not lenses:
        raise GsbaError(f"{runs['auto']}: the run has one centre, not two lenses")
    optics = Optics.of(lenses, reconstruction)
    between = one_eye_between(optics)
    split = split_frames(refined_frames(reconstruction), settings.held_out_every)
    exact, found = exact_faces(walk, split.held_out, settings.face_size), {}
    for row in rows:
        if row == "central":
            reconstruction, frames = load_run(runs["central"])
        taken = {"lenses": optics, "shorter": optics, "middle": between}.get(row, ONE_EYE)
        seen, chosen = optics if taken is optics else between, settings
        if row in ("lenses", "middle", "longer"):  # ten views a frame
            chosen = settings.model_copy(update={"iterations": settings.iterations * 10 // 6})
        poses, size = reconstruction.world_T_rigs, settings.face_size
        training = load_faces(frames, split.training, size, taken)
        held_out = load_faces(frames, split.held_out, size, seen)
        source = PosedViews.of(poses, split, training, held_out)
        backend, folder = choose_backend("cpu", threads), out / f"splat{seed}-{row}"
        key = digest(row, poses.tolist(), chosen)
        splat, result = train_and_measure(
            reconstruction, frames, source, chosen, backend, folder, key
        )
        near, there = (
            near_of(poses[split.training], chosen),
            make_views(exact, poses[split.held_out]),
        )
        apart = mean_score(measure(splat, there, chosen, near, backend).values())
        found[row] = result.mean, apart
        print(f"seed {seed} {row}: {result.mean} exact {apart}", flush=True)
    return found


def to_markdown(results: Mapping[int, Mapping[str, tuple[Score, Score]]]) -> str:
    """Table with a line for each row and the scores of each seed."""
    lines = [
        "| trained on | lenses' pixels: PSNR dB | of each seed | exposure aside dB | SSIM "
        "| exact: PSNR dB | of each seed | SSIM |",
        "|---|---:|---|---:|---:|---:|---|---:|",
    ]
    for row in next(iter(results.values())):
        both = [found[row] for found in results.values()]
        own, exact = (mean_score(part) for part in zip(*both, strict=True))
        each = ", ".join(f"{one.psnr:.2f}" for one, _ in both)
        clear = ", ".join(f"{one.psnr_exposed:.2f}" for _, one in both)
        lines.append(
            f"| {row} | {own.psnr:.2f} | {each} | {own.psnr_exposed:.2f} | {own.ssim:.4f} | "
            f"{exact.psnr_exposed:.2f} | {clear} | {exact.ssim:.4f} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder of walks, runs and splats")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--rows", nargs="+", default=list(ROWS), choices=ROWS)
    parser.add_argument(
        "--iterations", type=int, default=1500, help="training steps of six faces a frame"
    )
    parser.add_argument("--face-size", type=int, default=128)
    parser.add_argument("--max-gaussians", type=int, default=40_000)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    show_log()
    results, started = {}, time.process_time()
    for seed in options.seeds:
        settings = SplatSettings(
            iterations=options.iterations,
            face_size=options.face_size,
            sh_degree=1,
            max_gaussians=options.max_gaussians,
            backend="cpu",
            seed=seed,
            rate_means=5e-4,  # `splat_quality.py --rates short` uses these
            rate_means_end=5e-6,
            rate_scales=0.015,
            rate_fade=0.1,
        )
        rows = tuple(options.rows)
        results[seed] = run_seed(seed, options.out, settings, rows, options.threads)
    table = to_markdown(results)
    print(f"{machine()}; {time.process_time() - started:.0f} CPU s in this call\n\n{table}")
    if options.markdown:
        write_text(options.markdown, table)
    means = {
        row: np.mean([found[row][0].psnr for found in results.values()]) for row in options.rows
    }
    rivals = [row for row in ("middle", "stitched", "central") if row in means]
    behind = [row for row in rivals if "lenses" in means and means[row] > means["lenses"]]
    sys.exit(1 if behind else 0)


if __name__ == "__main__":
    main()
