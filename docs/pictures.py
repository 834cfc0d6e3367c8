r"""Draw the pictures of README and docs from what `gsba demo` leaves.

    gsba demo --frames 24 --width 768
    python docs/pictures.py gsba-demo
    python benchmarks/splat_quality.py --scenes demo_rectangle --out splats \
        --sources raw default --iterations 4000 --face-size 256 --max-gaussians 120000
    python docs/pictures.py gsba-demo --splats splats/demo_rectangle/splats0

Writes docs/images: trajectory.svg, residuals.jpg, cloud.jpg and, from what either
benchmarks/splat_quality.py or gsba evaluate --splat left, splats.svg. The colours are those of
report.html. The picture of the README is made on its own, by the commands that docs/splats.md has;
`--beside FOLDER` writes raw-and-refined.jpg alone.
"""

import argparse
import base64
import json
from pathlib import Path

import cv2
import numpy as np
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont

from gsba.evaluate import charts
from gsba.evaluate.trajectory import pose_errors
from gsba.frames.pixels import load_erp
from gsba.report.html.figures import viewing_axes
from gsba.report.html.pictures import picture, worst_frames
from gsba.store.finished import load_run
from gsba.trajectory.files import read_trajectory
from gsba.types import FACES, FrameSet, Reconstruction, Trajectory

PAGE, LINE, QUIET = "#f6f6f3", "#e3e3dd", "#6b6e73"
BEFORE, AFTER = charts.BEFORE, charts.AFTER
FONT = "system-ui,-apple-system,'Segoe UI',Roboto,Helvetica,Arial,sans-serif"
MAX_POINTS = 1600  # of the cloud, on the map
VECTOR_GAIN = 120  # times longer than the residual is


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("demo", type=Path, nargs="?", help="folder that gsba demo wrote")
    parser.add_argument("--run", type=Path, help="run to draw; DEMO/run by default")
    parser.add_argument("--splats", type=Path, help="folder with pictures/ and results.json")
    parser.add_argument("--beside", type=Path, help="as --splats; for raw-and-refined.jpg alone")
    parser.add_argument("--frame", help="held-out frame of raw-and-refined.jpg")
    parser.add_argument("--face", default="front", choices=FACES, help="and its face")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "images")
    arguments = parser.parse_args()
    if arguments.beside is not None:
        shown = beside(arguments.beside, arguments.frame, arguments.face)
        (arguments.out / "raw-and-refined.jpg").write_bytes(jpeg(shown, 250_000))
        return
    if arguments.demo is None:
        parser.error("give the folder that gsba demo wrote, or --beside")
    run = arguments.run or arguments.demo / "run"
    found, frames = load_run(run)
    truth = read_trajectory(arguments.demo / "walk" / "groundtruth.tum")
    coarse = read_trajectory(run / "coarse.tum")
    arguments.out.mkdir(parents=True, exist_ok=True)
    trajectory(arguments.out / "trajectory.svg", found, frames, coarse, truth)
    write(arguments.out / "residuals.jpg", residuals(found, frames))
    write(arguments.out / "cloud.jpg", cloud(found))
    if arguments.splats is not None:
        (arguments.out / "splats.svg").write_text(splats(arguments.splats))


def trajectory(
    path: Path, found: Reconstruction, frames: FrameSet, coarse: Trajectory, truth: Trajectory
) -> None:
    """Write the walk from above, before and after, and the error of every frame."""
    refined = Trajectory(frames.timestamps, found.world_T_rigs)
    errors = [pose_errors(poses, truth).positions for poses in (coarse, refined)]
    axes, _ = viewing_axes(found.world_T_rigs)
    centre = np.median(found.world_T_rigs[:, :3, 3], axis=0)

    def level(points: np.ndarray) -> np.ndarray:
        return ((points - centre) @ axes[:2].T).T

    def fill(figure: Figure) -> None:
        above, chart = figure.subplots(1, 2, width_ratios=(1.25, 1))
        walks = [level(poses.world_T_rigs[:, :3, 3]) for poses in (coarse, refined)]
        dots = level(found.points_world)
        reach = 1.75 * np.abs(walks[1]).max(axis=1, keepdims=True)
        near = np.flatnonzero((np.abs(dots) < reach).all(axis=0))
        dots = dots[:, near[:: max(1, len(near) // MAX_POINTS)]]
        above.plot(*dots, ".", color="#b9b7ae", markersize=1.5, rasterized=True)
        above.set_title("From above")
        above.set_aspect("equal", adjustable="datalim")
        above.axis("off")
        chart.set(title="Position error of every frame", yscale="log", xlabel="time, s")
        for walk, off, color, label in zip(
            walks, errors, (charts.BEFORE, charts.AFTER), ("before", "after"), strict=True
        ):
            above.plot(*walk, color=color)
            chart.plot(frames.timestamps, off, ".-", color=color, label=label)
        ratio = np.median(errors[0]) / np.median(errors[1])
        chart.legend(title=f"median {ratio:.0f} times smaller", loc="center right")

    charts.write([path], (8.2, 3.9), fill)


def _page(width: int, height: int, body: list[str]) -> str:
    """SVG of a rounded sheet with this on it."""
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" '
        f'height="{height}" font-family="{FONT}">\n'
        f'<rect x=".5" y=".5" width="{width - 1}" height="{height - 1}" rx="14" fill="{PAGE}" '
        f'stroke="{LINE}"/>\n' + "\n".join(body) + "\n</svg>\n"
    )


def _text(
    x: float, y: float, text: str, color: str, size: int, weight: int = 400, anchor: str = "start"
) -> str:
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" fill="{color}" font-size="{size}" font-weight="{weight}" '
        f'text-anchor="{anchor}">{text}</text>'
    )


def residuals(found: Reconstruction, frames: FrameSet) -> np.ndarray:
    """The worst frame's panorama with its residuals, `VECTOR_GAIN` times longer than they are."""
    f, width, fine = worst_frames(found)[0], 1200, 4  # fine: bits of sub-pixel drawing
    shown = cv2.resize(load_erp(frames, f), (width, width // 2), interpolation=cv2.INTER_CUBIC)
    vectors = picture(frames, found, f)["vectors"]
    starts = vectors[:, :2] * [width, width // 2]
    ends = starts + VECTOR_GAIN * vectors[:, 2:] * width / 360
    for start, end in zip(starts, ends, strict=True):
        a, b = (tuple(int(v) for v in np.round(p * 2**fine)) for p in (start, end))
        cv2.line(shown, a, b, (255, 255, 255), 4, cv2.LINE_AA, fine)
        cv2.line(shown, a, b, _rgb(BEFORE), 2, cv2.LINE_AA, fine)
        cv2.circle(shown, a, 3 * 2**fine, (255, 255, 255), -1, cv2.LINE_AA, fine)
        cv2.circle(shown, a, 2 * 2**fine, _rgb(AFTER), -1, cv2.LINE_AA, fine)
    return shown


def cloud(found: Reconstruction) -> np.ndarray:
    """The cloud and the walk from above at an angle, far points first."""
    width, height, over = 1200, 640, 2
    axes, _ = viewing_axes(found.world_T_rigs)
    positions = (found.world_T_rigs[:, :3, 3]) @ axes.T
    centre, extent = (positions.min(0) + positions.max(0)) / 2, np.ptp(positions, axis=0).max()
    eye = centre + extent * np.array([0.3, -1.45, 1.25])
    ahead = (centre - eye) / np.linalg.norm(centre - eye)
    right = np.cross(ahead, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    camera = np.array([right, np.cross(ahead, right), ahead])
    focal = 1.05 * width * over

    def seen(points: np.ndarray) -> np.ndarray:
        local = (points - eye) @ camera.T
        pixels = local[:, :2] / np.maximum(local[:, 2:], 1e-6) * focal
        return np.column_stack([pixels + np.array([width, height]) * over / 2, local[:, 2]])

    canvas = np.full((height * over, width * over, 3), _rgb(PAGE), np.uint8)
    points = seen(found.points_world @ axes.T)
    ceiling = np.percentile((found.points_world @ axes.T)[:, 2], 80)
    low = (found.points_world @ axes.T)[:, 2] < ceiling  # look in from above
    for row in np.argsort(-points[:, 2]):
        x, y, depth = points[row]
        if low[row] and depth > 0.05 * extent:
            radius = max(2, round(0.0042 * extent * focal / depth))
            color = tuple(int(v) for v in found.point_colors[row])
            cv2.circle(canvas, (round(x), round(y)), radius, color, -1, cv2.LINE_AA)
    path = seen(positions)
    corners = [np.round(path[:, :2]).astype(np.int32)]
    cv2.polylines(canvas, corners, False, (255, 255, 255), 6 * over, cv2.LINE_AA)
    cv2.polylines(canvas, corners, False, _rgb(AFTER), 3 * over, cv2.LINE_AA)
    for x, y, _ in path:
        cv2.circle(canvas, (round(x), round(y)), 7 * over, (255, 255, 255), -1, cv2.LINE_AA)
        cv2.circle(canvas, (round(x), round(y)), 5 * over, _rgb(AFTER), -1, cv2.LINE_AA)
    return cv2.resize(canvas, (width, height), interpolation=cv2.INTER_AREA)


def splats(folder: Path) -> str:
    """SVG: faces of a held-out frame as captured, and as splats on coarse and refined poses are."""
    scores = json.loads((folder / "results.json").read_text())["sources"]
    pictures = sorted((folder / "pictures").glob("*.jpg"))
    path = pictures[len(pictures) // 2]
    sheet = cv2.imread(str(path))[..., ::-1]  # a row of faces: as captured, then of each source
    size = sheet.shape[1] // 6
    refined = next(name for name in ("refined", "default") if name in scores)
    coarse = next(name for name in scores if name not in (refined, "truth"))
    shown = [("captured", 0, QUIET)]
    for name, label, color in (
        (coarse, "on coarse poses", BEFORE),
        (refined, "on refined poses", AFTER),
    ):
        found = scores[name]["frames"][path.stem]["psnr"]
        shown.append((f"{label}, {found:.1f} dB", 1 + list(scores).index(name), color))
    wide, gap, head = 286, 12, 52
    width, height = 3 * wide + 4 * gap, head + 2 * wide + gap
    body = []
    for column, (label, row, color) in enumerate(shown):
        faces = [sheet[row * size : (row + 1) * size, c * size : (c + 1) * size] for c in (0, 1)]
        image = cv2.resize(
            np.concatenate(faces), (3 * wide // 2, 3 * wide), interpolation=cv2.INTER_CUBIC
        )
        data = base64.b64encode(jpeg(image, 34_000)).decode()
        x = gap + column * (wide + gap)
        body.append(
            f'<image x="{x}" y="{head}" width="{wide}" height="{2 * wide}" '
            f'href="data:image/jpeg;base64,{data}"/>'
        )
        body.append(_text(x + 2, 33, label, color, 15, 600))
    return _page(width, height, body)


def beside(folder: Path, frame: str | None, face: str) -> np.ndarray:
    """A face of a held-out frame as splats on coarse and on refined poses show it, RGB."""
    names = list(json.loads((folder / "results.json").read_text())["sources"])
    pictures = sorted((folder / "pictures").glob("*.jpg"))
    path = folder / "pictures" / f"{frame}.jpg" if frame else pictures[len(pictures) // 2]
    sheet = cv2.imread(str(path))[..., ::-1]  # as for `splats`
    size, wide, gap = sheet.shape[1] // len(FACES), 600, 12
    column, coarse = FACES.index(face), next(n for n in range(len(names)) if names[n] != "refined")
    canvas = Image.new("RGB", (2 * wide + gap, wide), PAGE)
    draw, font = ImageDraw.Draw(canvas), ImageFont.load_default(26)
    for place, (row, label, color) in enumerate(
        ((coarse, "raw SLAM poses", BEFORE), (names.index("refined"), "refined poses", AFTER))
    ):
        rows, columns = (slice(n * size, (n + 1) * size) for n in (1 + row, column))
        image = cv2.resize(sheet[rows, columns], (wide, wide), interpolation=cv2.INTER_CUBIC)
        x = place * (wide + gap)
        canvas.paste(Image.fromarray(image), (x, 0))
        draw.rectangle((x, 0, x + 36 + draw.textlength(label, font), 48), fill=PAGE)
        draw.text((x + 16, 8), label, fill=color, font=font)
    return np.asarray(canvas)


def _rgb(color: str) -> tuple[int, int, int]:
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:], 16)


def write(path: Path, image: np.ndarray) -> None:
    path.write_bytes(jpeg(image, 150_000))


def jpeg(image: np.ndarray, most: int) -> bytes:
    """RGB image as JPEG of at most so many bytes, or as small as it gets."""
    for quality in (90, 85, 80, 75, 70, 62, 54, 46):
        options = [cv2.IMWRITE_JPEG_QUALITY, quality]
        encoded = cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), options)[1]
        if len(encoded) <= most:
            break
    return encoded.tobytes()


if __name__ == "__main__":
    main()
