"""What refined poses are worth to a splat: raw trajectory, refined and true poses, one recipe.

    python benchmarks/splat_quality.py --out WORK --scenes demo_rectangle
    python benchmarks/splat_quality.py --out WORK --scenes aisle_loop --data FOLDER

Every source trains on the same frames with the same settings and seed, on the CPU, and is measured
on whole panoramas it never saw, at its own poses. Scenes named demo_… are rendered on the spot, the
others are folders of FOLDER with images/, slam.tum and groundtruth.tum. Runs and splats are kept in
WORK and taken up again. The last lines say whether the targets hold; exit 1 where one is missed.
"""

import argparse
import json
import sys
import time
from dataclasses import asdict
from pathlib import Path

from common import machine

from gsba.config import RefineSettings, SplatSettings
from gsba.demo import make_walk
from gsba.evaluate_splat import SourceResult, compare, format_table, poses_for
from gsba.log import GsbaError, show_log
from gsba.pipeline import load_run, refine
from gsba.read import read_trajectory
from gsba.records import atomic_write
from gsba.splat.backend import choose_backend

WALKS = {"demo_rectangle": ("rectangle", "locked"), "demo_oval": ("oval", "forward")}
GAIN_DB, GAIN_SSIM = 4.66, 0.073  # of refined over raw poses, at least
SHORT_DB = 0.1  # of refined poses behind true ones, at most


def find_scene(name: str, data: Path | None, out: Path) -> Path:
    """Folder with images/, slam.tum and groundtruth.tum.

    Raises:
        GsbaError: the scene is not on this machine.
    """
    if name in WALKS:
        folder = out / name / "walk"
        if not folder.exists():
            make_walk(folder, *WALKS[name])  # type: ignore[arg-type]
        return folder
    folder = Path() if data is None else data / name
    if data is None or not (folder / "groundtruth.tum").is_file():
        raise GsbaError(f"{name} needs --data: a folder with {name}/groundtruth.tum")
    return folder


def run_scene(folder: Path, out: Path, settings: SplatSettings) -> dict[str, SourceResult]:
    """Refine, then train and measure on all three sources of poses."""
    quiet = RefineSettings.model_validate({"export": {"formats": []}})
    refine(folder / "images", folder / "slam.tum", out / "run", quiet)
    reconstruction, frames = load_run(out / "run")
    sources = {
        "raw": poses_for(frames, read_trajectory(folder / "slam.tum")),
        "refined": reconstruction.world_T_rigs,
        "truth": poses_for(frames, read_trajectory(folder / "groundtruth.tum")),
    }
    backend = choose_backend(settings.backend)
    return compare(reconstruction, frames, sources, settings, backend, out / "splats")


def verdicts(results: dict[str, SourceResult]) -> list[tuple[str, bool]]:
    """Each target with the figure found, and whether it holds."""
    raw, refined, truth = (results[name].mean for name in ("raw", "refined", "truth"))
    gain, similar = refined.psnr - raw.psnr, refined.ssim - raw.ssim
    short = truth.psnr - refined.psnr
    return [
        (f"refined over raw {gain:+.2f} dB, at least {GAIN_DB:+.2f}", gain >= GAIN_DB),
        (f"refined over raw {similar:+.4f} SSIM, at least {GAIN_SSIM:+.3f}", similar >= GAIN_SSIM),
        (f"refined {short:.2f} dB behind truth, at most {SHORT_DB}", short <= SHORT_DB),
    ]


def main() -> None:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder of runs and splats")
    parser.add_argument("--scenes", nargs="+", default=list(WALKS))
    parser.add_argument("--data", type=Path, help="folder of recorded scenes")
    parser.add_argument("--iterations", type=int, default=3000)
    parser.add_argument("--face-size", type=int, default=192)
    parser.add_argument("--sh-degree", type=int, default=1)
    parser.add_argument("--max-gaussians", type=int, default=40_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    show_log()
    settings = SplatSettings(
        iterations=options.iterations,
        face_size=options.face_size,
        sh_degree=options.sh_degree,
        max_gaussians=options.max_gaussians,
        seed=options.seed,
        backend="cpu",
    )
    print(machine())
    held, report = True, {}
    for name in options.scenes:
        started = time.process_time()
        try:
            results = run_scene(
                find_scene(name, options.data, options.out), options.out / name, settings
            )
        except GsbaError as error:
            print(f"\n{name}: skipped, {error}")
            continue
        judged = verdicts(results)
        print(f"\n{name}, {time.process_time() - started:.0f} CPU s\n{format_table(results)}")
        for text, holds in judged:
            print(f"{'ok  ' if holds else 'MISS'} {text}", flush=True)
        held &= all(holds for _, holds in judged)
        report[name] = {
            "sources": {source: asdict(result) for source, result in results.items()},
            "verdicts": [{"target": text, "holds": holds} for text, holds in judged],
        }
    if options.json:
        content = {"machine": machine(), "settings": settings.model_dump(), "scenes": report}
        text = json.dumps(content, indent=1) + "\n"
        atomic_write(options.json, lambda path: path.write_text(text))
    sys.exit(0 if held else 1)


if __name__ == "__main__":
    main()
