"""Run the commands of tutorial.md, write their answers into it, and take its pictures.

    python docs/tutorial.py WORK

WORK gets the film and what the commands write; what is there already is used again. Needs
`pip install '.[dev]'` and Chromium.
"""

import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pictures import write

from gsba.demo.walk import make_film
from gsba.evaluate import charts
from gsba.frames.pixels import load_erp
from gsba.report.html.figures import viewing_axes
from gsba.store.finished import load_run
from gsba.trajectory.files import read_trajectory

HERE = Path(__file__).parent
GSBA = (sys.executable, "-c", "from gsba.cli import main; main()")
BLOCKS = re.compile(r"^```\n(gsba .*?)^```$(?:\n\n```text\n(.*?)^```$)?", re.MULTILINE | re.DOTALL)
FILM = {"num_frames": 60, "width": 512}
SIZE = {"width": 1100, "height": 880}
MAX_LINES = 12  # of an answer
DRAWING = ("--no-sandbox", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")


def main() -> None:
    work = Path(sys.argv[1] if len(sys.argv) > 1 else "tutorial").resolve()
    work.mkdir(parents=True, exist_ok=True)
    if not (work / "walk.mp4").exists():
        film = make_film(work / "film", **FILM)  # type: ignore[arg-type]
        shutil.copy(film.video_path, work / "walk.mp4")
    page = HERE / "tutorial.md"
    text = page.read_text()
    page.write_text(BLOCKS.sub(lambda block: run_block(block, work), text))


def run_block(block: re.Match[str], work: Path) -> str:
    """Run a block's commands and take their pictures; returns the block with their answer."""
    answer = ""
    for line in block[1].splitlines():
        command = shlex.split(line)[1]
        if command == "view":
            picture_of_viewer(work, shlex.split(line)[1:])
        else:
            done = subprocess.run(
                [*GSBA, *shlex.split(line)[1:]], cwd=work, capture_output=True, text=True
            )
            if done.returncode:
                sys.exit(f"{line}\n{done.stdout}{done.stderr}")
            answer += done.stdout
        if command in PICTURES:
            PICTURES[command](work)
    start, end = block[0].split(block[1])[0], ""
    if block[2] is not None:
        lines = answer.replace(f"{work}/", "").rstrip().splitlines()[-MAX_LINES:]
        end = "\n\n```text\n" + "".join(f"{line}\n" for line in lines) + "```"
    return f"{start}{block[1]}```{end}"


def picture_of_video(work: Path) -> None:
    video = cv2.VideoCapture(str(work / "walk.mp4"))
    frames = []
    while (read := video.read())[0]:
        frames.append(read[1][..., ::-1])
    chosen = [frames[k] for k in np.linspace(0, len(frames) - 1, 4).astype(int)]
    rows = [np.hstack([cv2.resize(f, (550, 275)) for f in chosen[k : k + 2]]) for k in (0, 2)]
    write(HERE / "images/tutorial-video.jpg", np.vstack(rows))


def picture_of_track(work: Path) -> None:
    poses = read_trajectory(work / "track.tum").world_T_rigs
    keyframes = read_trajectory(work / "track-keyframes.tum").world_T_rigs
    axes, _ = viewing_axes(poses)
    path, dots = (poses[:, :3, 3] @ axes[:2].T for poses in (poses, keyframes))

    def fill(figure: Any) -> None:
        plot = figure.subplots()
        plot.scatter(*path.T, c=np.arange(len(path)), cmap="viridis", s=6)
        plot.plot(*dots.T, "o", color=charts.AFTER, fillstyle="none", markersize=9)
        plot.set_aspect("equal", adjustable="datalim")
        plot.set(xlabel="map units", ylabel="map units")

    target = work / "track.png"
    charts.write([target], (8.2, 3.9), fill)
    image = cv2.imread(str(target))
    assert image is not None
    write(HERE / "images/tutorial-track.jpg", image[..., ::-1])


def picture_of_report(work: Path) -> None:
    taken(f"file://{work}/walk/report.html", "tutorial-report", lambda page: None)


def picture_of_viewer(work: Path, words: list[str]) -> None:
    """Start the viewer, look at it, and stop it."""
    given = [*GSBA, *words, "--port", "0"]
    with subprocess.Popen(given, cwd=work, stdout=subprocess.PIPE, text=True) as viewer:
        assert viewer.stdout is not None
        found = None
        while found is None and (line := viewer.stdout.readline()):
            found = re.search(r"http://127\.0\.0\.1:\d+\S*", line)
        if found is None:
            sys.exit("gsba view printed no address")
        try:
            taken(found[0], "tutorial-viewer", seen)
        finally:
            viewer.terminate()


def seen(page: Any) -> None:
    """Wait until a viewer has drawn its scene."""
    page.locator("canvas").first.wait_for(timeout=120_000)
    page.wait_for_timeout(30_000)  # the scene comes over a socket, drawn without a GPU
    for close in page.locator(".mantine-Notification-closeButton").all():
        close.click()  # says so
    page.wait_for_timeout(3000)


def picture_of_splat(work: Path) -> None:
    """A frame as captured, beside the splat at its pose."""
    (rendered,) = (work / "walk/renderings").glob("*_erp.png")
    _, frames = load_run(work / "walk")
    captured = load_erp(frames, frames.names.index(rendered.stem.removesuffix("_erp")))
    shown = cv2.imread(str(rendered))
    assert shown is not None
    pair = [cv2.resize(image, (550, 275)) for image in (captured, shown[..., ::-1])]
    write(HERE / "images/tutorial-splat.jpg", np.hstack(pair))


def taken(address: str, name: str, ready: Callable[[Any], None]) -> None:
    """Take a picture of a page in Chromium."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=list(DRAWING)
        )
        page = browser.new_page(viewport=SIZE)
        page.goto(address)
        page.wait_for_timeout(3000)
        ready(page)
        page.screenshot(path=str(HERE / f"images/{name}.jpg"), type="jpeg", quality=80)
        browser.close()


PICTURES: dict[str, Callable[[Path], None]] = {
    "info": picture_of_video,
    "track": picture_of_track,
    "refine": picture_of_report,
    "render": picture_of_splat,
}


if __name__ == "__main__":
    main()
