"""Quality of splats by poses: coarse, refined by each set of factors, COLMAP's and true ones.

    python benchmarks/splat_quality.py --out WORK --scenes demo_rectangle demo_oval
    python benchmarks/splat_quality.py --out WORK --scenes aisle_loop apartment --data FOLDER

Splats of all sources of poses are trained on the same frames with the same settings and seeds, on
the CPU, and measured on held-out panoramas at the source's own poses. Densification is chaotic:
almost equal poses give scores that differ by tenths of a dB, so that means over several `--seeds`
are compared. Scenes named demo_… are rendered; the others are folders of FOLDER with images/, a
coarse trajectory (`--coarse NAME` takes another one, with its own WORK), and, if they exist,
groundtruth.tum and mask.png. COLMAP's poses are peer_colmap.tum of the folder, or the result of
`benchmarks/peer.py`. Runs, models and splats are kept in WORK and resumed. The lines below a table
state whether the targets hold; the exit code is 1 if one is missed.
"""

import argparse
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from common import link_frames, machine

from gsba.config import RefineSettings
from gsba.demo import make_walk
from gsba.disk import write_text
from gsba.evaluate.splats import SourceResult, compare, poses_for
from gsba.log import GsbaError, show_log
from gsba.pipeline.refine import refine
from gsba.splat.backend import choose_backend
from gsba.splat.options import TrainingOptions
from gsba.splat.scores import Score, mean_score
from gsba.store.finished import load_run
from gsba.trajectory.files import read_trajectory
from gsba.types import FrameSet

WALKS = {"demo_rectangle": ("rectangle", "locked"), "demo_oval": ("oval", "forward")}
REFINED = {
    "default": {},
    "unaligned": {"patches": {"rounds": 0}},
    "splat": {"factors": ("bearing", "splat")},
}  # row -> settings of `gsba refine`; the first row is the one that targets are about
SOURCES = ("raw", "unaligned", "default", "splat", "colmap", "truth")
RATES: dict[str, dict[str, Any]] = {
    "short": {  # for some thousand steps: the last views must not leave their exposure
        "rate_means": 5e-4,
        "rate_means_end": 5e-6,
        "rate_scales": 0.015,
        "rate_fade": 0.1,
    },
    "published": {},
}
PEER = "spherical-incremental"
GAIN_DB, GAIN_SSIM = 4.66, 0.073  # of refined over raw poses, at least
SHORT_DB = 0.1  # of refined poses behind true ones, at most
LEVEL_DB = 0.05  # of refined poses behind COLMAP's, at most


def find_scene(name: str, data: Path | None, out: Path) -> Path:
    """Folder with images/ and trajectories.

    Raises:
        GsbaError: the scene is not on this machine.
    """
    if name in WALKS:
        folder = out / name / "walk"
        if not folder.exists():
            make_walk(folder, *WALKS[name])  # type: ignore[arg-type]
        return folder
    folder = Path() if data is None else data / name
    if data is None or not (folder / "images").is_dir():
        raise GsbaError(f"{name} needs --data: a folder with {name}/images")
    return folder


def find_poses(
    row: str, folder: Path, coarse: Path, out: Path, frames: FrameSet
) -> np.ndarray | None:
    """Poses (F, 4, 4) of one source; None if the scene has none."""
    if row in REFINED:
        return load_run(_refined(row, folder, coarse, out))[0].world_T_rigs
    if row == "raw":
        return poses_for(frames, read_trajectory(coarse))
    path = folder / ("groundtruth.tum" if row == "truth" else "peer_colmap.tum")
    if path.is_file():
        return poses_for(frames, read_trajectory(path))
    return None if row == "truth" else _peer(folder, out, frames)


def find_coarse(folder: Path, names: Sequence[str]) -> Path:
    """First trajectory with one of these names in a scene.

    Raises:
        GsbaError: the scene has none of them.
    """
    for name in names:
        if (folder / name).is_file():
            return folder / name
    raise GsbaError(f"{folder} has no {' or '.join(names)}: name its trajectory by --coarse")


def _refined(row: str, folder: Path, coarse: Path, out: Path) -> Path:
    """Finished run; stages shared with the first run are copied from it."""
    run, first = out / f"run-{row}", out / f"run-{next(iter(REFINED))}"
    if not run.exists() and first.exists():
        shutil.copytree(first, run)
    settings = RefineSettings.model_validate({"export": {"formats": []}, **REFINED[row]})
    mask = folder / "mask.png"
    masks = mask if mask.is_file() else None
    refine(folder / "images", coarse, run, settings, masks=masks)
    return run


def _peer(folder: Path, out: Path, frames: FrameSet) -> np.ndarray:
    """Poses of COLMAP's panorama pipeline on the frames, without a trajectory."""
    model = out / PEER / "model"
    if not (model / "trajectory.tum").is_file():
        links = link_frames([path for (path,) in frames.paths], out / "images")
        script = str(Path(__file__).with_name("peer.py"))
        subprocess.run([sys.executable, script, PEER, str(links), str(model)], check=True)
    posed = read_trajectory(model / "trajectory.tum")
    poses = np.full((len(frames), 4, 4), np.nan)
    poses[posed.timestamps.astype(int)] = posed.world_T_rigs
    return poses


def run_scene(
    folder: Path,
    coarse: Path,
    out: Path,
    rows: list[str],
    settings: list[TrainingOptions],
    threads: int,
) -> dict[str, list[SourceResult]]:
    """Refine, then train and measure on all sources of poses, once for each of the settings."""
    first = next(iter(REFINED))
    reconstruction, frames = load_run(_refined(first, folder, coarse, out))
    found = {row: find_poses(row, folder, coarse, out, frames) for row in rows}
    sources = {row: poses for row, poses in found.items() if poses is not None}
    backend = choose_backend("cpu", threads)
    found = [
        compare(reconstruction, frames, sources, some, backend, out / f"splats{some.seed}")
        for some in settings
    ]
    return {row: [results[row] for results in found] for row in sources}


def mean_of(results: list[SourceResult]) -> Score:
    """Mean over seeds of the means over panoramas."""
    return mean_score(result.mean for result in results)


def verdicts(results: dict[str, list[SourceResult]]) -> list[tuple[str, bool]]:
    """Targets with the measured figures, and True if they hold."""
    means = {row: mean_of(result) for row, result in results.items()}
    ours, judged = means[next(iter(REFINED))], []
    if "raw" in means:
        gain, similar = ours.psnr - means["raw"].psnr, ours.ssim - means["raw"].ssim
        judged += [
            (f"refined over raw {gain:+.2f} dB, at least {GAIN_DB:+.2f}", gain >= GAIN_DB),
            (
                f"refined over raw {similar:+.4f} SSIM, at least {GAIN_SSIM:+.3f}",
                similar >= GAIN_SSIM,
            ),
        ]
    for row, most in (("truth", SHORT_DB), ("colmap", LEVEL_DB)):
        if row in means:
            short = means[row].psnr - ours.psnr
            judged.append((f"refined {short:.2f} dB behind {row}, at most {most}", short <= most))
    return judged


def to_markdown(name: str, results: dict[str, list[SourceResult]], seconds: float) -> str:
    """Table of a scene, with its targets."""
    first = next(iter(results.values()))
    raw, frames = mean_of(first), len(first[0].frames)
    lines = [
        f"## {name}",
        "",
        f"{frames} held-out panoramas, {len(first)} seeds; {seconds:.0f} CPU s in this call.",
        "",
        "| poses | PSNR dB | of each seed | SSIM | over the first dB | SSIM | exposure aside dB |",
        "|---|---:|---|---:|---:|---:|---:|",
    ]
    for row, result in results.items():
        mean, each = mean_of(result), ", ".join(f"{one.mean.psnr:.2f}" for one in result)
        lines.append(
            f"| {row} | {mean.psnr:.2f} | {each} | {mean.ssim:.4f} | {mean.psnr - raw.psnr:+.2f} | "
            f"{mean.ssim - raw.ssim:+.4f} | {mean.psnr_exposed:.2f} |"
        )
    judged = verdicts(results)
    lines += ["", *(f"- {'ok' if ok else '**missed**'}: {what}" for what, ok in judged), ""]
    return "\n".join(lines)


def main() -> None:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder of runs and splats")
    parser.add_argument("--scenes", nargs="+", default=list(WALKS))
    parser.add_argument("--sources", nargs="+", default=list(SOURCES), choices=SOURCES)
    parser.add_argument("--data", type=Path, help="folder of recorded scenes")
    parser.add_argument(
        "--coarse",
        nargs="+",
        default=["slam.tum", "coarse.tum"],
        help="names of the coarse trajectory; the first that exists is taken",
    )
    parser.add_argument("--iterations", type=int, default=800)
    parser.add_argument("--rates", choices=RATES, default="short", help="of learning")
    parser.add_argument("--face-size", type=int, default=128)
    parser.add_argument("--sh-degree", type=int, default=1)
    parser.add_argument("--max-gaussians", type=int, default=40_000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--threads", type=int, default=2, help="of the renderer")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    show_log()
    settings = TrainingOptions(
        iterations=options.iterations,
        face_size=options.face_size,
        sh_degree=options.sh_degree,
        max_gaussians=options.max_gaussians,
        backend="cpu",
        **RATES[options.rates],
    )
    print(machine())
    held, report, text = True, {}, []
    for name in options.scenes:
        started, out = time.process_time(), options.out / name
        try:
            folder = find_scene(name, options.data, options.out)
            seeded = [settings.model_copy(update={"seed": seed}) for seed in options.seeds]
            coarse = find_coarse(folder, options.coarse)
            results = run_scene(folder, coarse, out, options.sources, seeded, options.threads)
        except GsbaError as error:
            print(f"\n{name}: skipped, {error}")
            continue
        section = to_markdown(name, results, time.process_time() - started)
        print(f"\n{section}", flush=True)
        judged = verdicts(results)
        held &= all(holds for _, holds in judged)
        text.append(section)
        report[name] = {
            "sources": {row: [asdict(one) for one in result] for row, result in results.items()},
            "verdicts": [{"target": what, "holds": holds} for what, holds in judged],
        }
        _write(options, settings, report, text)
    sys.exit(0 if held else 1)


def _write(
    options: argparse.Namespace, settings: TrainingOptions, report: dict, text: list
) -> None:
    """Write the results so far."""
    if options.json:
        content = {"machine": machine(), "settings": settings.model_dump(), "scenes": report}
        lines = json.dumps(content, indent=1) + "\n"
        write_text(options.json, lines)
    if options.markdown:
        head = f"# Splats on raw, refined, COLMAP's and true poses\n\n{machine()}; faces of "
        head += f"{settings.face_size} px, {settings.iterations} steps, {options.rates} rates.\n"
        page = "\n".join([head, *text])
        write_text(options.markdown, page)


if __name__ == "__main__":
    main()
