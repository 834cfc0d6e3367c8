"""Refinement of a generated 4K video in one call, and through a folder of extracted frames.

    python benchmarks/video.py --frames 120                     # full size
    python benchmarks/video.py --frames 24 --rendered-width 1280    # cheaper: coarser images

The walk of `gsba demo` is encoded over `--seconds` at irregular presentation times (a variable
frame rate), H.264, 3840x1920. Every frame of the video is another pose, so that the frame rate is
frames / seconds and not that of a camera; images rendered coarser than the video are enlarged.
Targets: times are correct to 1 ms, both ways give the same poses, and these are close to the truth.
The exit code is 1 if a target is missed.
"""

import argparse
import csv
import json
import sys
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
from common import Measurement, machine, measure

from gsba.demo.degrade import degrade
from gsba.demo.gallery import build_gallery
from gsba.demo.render import render_erp
from gsba.demo.walk import walk_poses
from gsba.evaluate.trajectory import evaluate
from gsba.log import track
from gsba.trajectory.files import read_trajectory, write_tum
from gsba.types import Trajectory

TICK = Fraction(1, 90_000)  # seconds, of the container's clock
WIDTH, HEIGHT = 3840, 1920
MAX_TIME_ERROR_S = 1e-3
GSBA = [sys.executable, "-c", "from gsba.cli import main; main()"]
TIMEOUT_S = 7200.0


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("benchmark-video"))
    parser.add_argument("--frames", type=int, default=120, help="poses, and pictures of the video")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rendered-width", type=int, default=WIDTH)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    video, ticks, truth = make_video(options)
    slam = options.out / "slam.tum"
    write_tum(slam, degrade(truth, seed=0))
    runs = {"video": options.out / "from-video", "folder": options.out / "from-folder"}
    frames = options.out / "frames"
    every = ["--set", "video.every=1"]
    costs = {
        "refine VIDEO": call("refine", video, slam, "--out", runs["video"], "--fresh", *every),
        "extract": call("extract", video, "--out", frames, "--every", 1, "--fresh"),
        "refine FRAMES": call("refine", frames, slam, "--out", runs["folder"], "--fresh", *every),
    }
    result = compare(runs, frames, ticks, truth, slam)
    result |= {"machine": machine(), "video_mb": video.stat().st_size / 1e6}
    result["costs"] = {name: {"wall_s": c.wall_s, "cpu_s": c.cpu_s} for name, c in costs.items()}
    result |= {key: getattr(options, key) for key in ("frames", "seconds", "rendered_width")}
    text = table(result)
    print(text)
    if options.json:
        options.json.write_text(json.dumps(result, indent=1) + "\n")
    if options.markdown:
        options.markdown.write_text(text)
    sys.exit(not all(targets(result).values()))


def make_video(options: argparse.Namespace) -> tuple[Path, np.ndarray, Trajectory]:
    """Video, presentation times (F,) of its frames in ticks, and its true poses on that clock."""
    import av

    rng = np.random.default_rng(1)
    num = options.frames
    even = np.arange(num) * options.seconds / num
    times = even + rng.uniform(0, 0.5, num) * options.seconds / num * (np.arange(num) > 0)
    ticks = np.round(times / float(TICK)).astype(np.int64)
    poses = walk_poses("rectangle", "locked", num, 0).world_T_rigs
    truth = Trajectory(ticks * float(TICK), poses)
    video = options.out / f"walk-{num}-{options.rendered_width}.mp4"
    if video.exists():
        return video, ticks, truth
    scene, partial = build_gallery(), video.with_suffix(".partial.mp4")
    with av.open(str(partial), "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "16", "preset": "fast"})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.time_base = stream.codec_context.time_base = TICK
        pictures = zip(ticks, poses, strict=True)
        for tick, world_T_rig in track(pictures, "rendering the video", total=num):
            wide = options.rendered_width
            image = np.clip(render_erp(scene, world_T_rig, wide, wide // 2) + 0.5, 0, 255)
            if wide != WIDTH:
                image = cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
                image = np.clip(image, 0, 255)
            frame = av.VideoFrame.from_ndarray(image.astype(np.uint8), format="rgb24")
            frame.pts, frame.time_base = int(tick), TICK
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    partial.rename(video)
    return video, ticks, truth


def call(*arguments: object) -> Measurement:
    """Run a gsba command in a separate process; its output is written beside the video."""
    words = [str(argument) for argument in arguments]
    cost = measure([*GSBA, *words], Path(words[words.index("--out") + 1] + ".log"), TIMEOUT_S)
    if cost.exit_code:
        raise SystemExit(f"gsba {' '.join(words)} failed: see its log")
    return cost


def compare(
    runs: dict[str, Path], frames: Path, ticks: np.ndarray, truth: Trajectory, slam: Path
) -> dict:
    """Errors of times and poses."""
    found = {name: read_trajectory(run / "trajectory.tum") for name, run in runs.items()}
    exact = (ticks - ticks[0]) * float(TICK)
    time_errors = {"video": np.abs(found["video"].timestamps - exact).max()}
    for name, folder in (("extracted", frames), ("run/frames", runs["video"] / "frames")):
        with (folder / "timestamps.csv").open() as file:
            listed = np.array([float(row["timestamp"]) for row in csv.DictReader(file)])
        time_errors[name] = np.abs(listed - exact).max()
    difference = np.abs(found["video"].world_T_rigs - found["folder"].world_T_rigs).max()
    before, after = (evaluate(t, truth) for t in (read_trajectory(slam), found["video"]))
    return {
        "max_time_error_s": {name: float(error) for name, error in time_errors.items()},
        "max_pose_difference": float(difference),
        "ate_before": before.ate.rmse,
        "ate_after": after.ate.rmse,
        "rotation_after_deg": after.rpe_rotation_deg.median,
        "posed": after.num_matched,
    }


def targets(result: dict) -> dict[str, bool]:
    """Targets, with True if they hold."""
    worst = max(result["max_time_error_s"].values())
    return {
        f"times exact to 1 ms: worst {1e3 * worst:.4f} ms": worst <= MAX_TIME_ERROR_S,
        f"both routes equal: poses differ by {result['max_pose_difference']:.1e}": result[
            "max_pose_difference"
        ]
        == 0,
        f"all frames posed: {result['posed']} of {result['frames']}": result["posed"]
        == result["frames"],
    }


def table(result: dict) -> str:
    """Markdown table of the result."""
    enlarged = f", rendered {result['rendered_width']} wide and enlarged"
    lines = [
        "# A 4K video refined in one call, and by way of a folder",
        "",
        f"{result['machine']}",
        "",
        f"{result['seconds']:g} s, {WIDTH}x{HEIGHT}, H.264, {result['frames']} pictures at "
        f"irregular times{enlarged if result['rendered_width'] != WIDTH else ''}, "
        f"{result['video_mb']:.1f} MB.",
        "",
        "| | wall s | CPU s |",
        "|---|---:|---:|",
        *(f"| `{n}` | {c['wall_s']:.1f} | {c['cpu_s']:.1f} |" for n, c in result["costs"].items()),
        "",
        "| | ATE rmse | rel. rot. ° |",
        "|---|---:|---:|",
        f"| coarse | {result['ate_before']:.5f} | |",
        f"| refined | {result['ate_after']:.5f} | {result['rotation_after_deg']:.4f} |",
        "",
        *(f"- {'ok' if held else '**missed**'}: {what}" for what, held in targets(result).items()),
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
