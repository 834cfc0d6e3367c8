"""Pictures of footage and facts about it, by a process of its own (`python -m gsba.app.pictures`)
that answers a JSON line for each task: the server ends it where a decoder of a damaged file hangs.
"""

import json
import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

from gsba.frames.files import decode, image_size, is_image
from gsba.log import GsbaError, brief
from gsba.video.timeline import is_video, picture_near

SMALL, LARGE = 320, 2048  # pixels across a picture of the list, and of a panorama to look around in


def picture_of(path: Path, width: int, share: float) -> bytes:
    """JPEG of a video's frame, of an image, or of an image of a folder.

    Args:
        path: video, image, or folder with images, or with folders of these, one a lens.
        width: pixels across; smaller pictures keep their size.
        share: place in a video or folder, 0..1 of its duration or images.

    Raises:
        GsbaError: there is no picture, or it cannot be decoded.
    """
    if path.is_dir():
        folders = (path, *sorted(each for each in path.iterdir() if each.is_dir()))
        every = (sorted(filter(is_image, folder.iterdir())) for folder in folders)
        images = next(filter(None, every), None)
        if images is None:
            raise GsbaError(f"{path} holds no images")
        path = images[int(share * (len(images) - 1))]
    if is_video(path):
        return _jpeg(picture_near(path, share), width)
    return _jpeg(decode(path, image_size(path), at_least=width)[..., ::-1], width)


def frame_of(run: Path, frame: int, width: int) -> bytes:
    """JPEG of the panorama of a run's frame, read by the calibration that the run found, if it has.
    Raises GsbaError: it is no run, has no such frame yet, or the frame cannot be decoded."""
    from gsba.report.html.pictures import small_panorama
    from gsba.store.store import load_stage
    from gsba.types import FrameSet, Reconstruction

    frames = load_stage(run, "frames", FrameSet)
    with suppress(GsbaError):  # the run goes on
        found = load_stage(run, "reconstruction", Reconstruction)
        frames = frames.with_formats(found.formats or frames.formats)
    if not 0 <= frame < len(frames):
        raise GsbaError(f"{run} has no frame {frame}: it has {len(frames)}")
    widest = frames.format_of(frame).panorama_width
    return _jpeg(small_panorama(frames, frame, min(width, widest))[..., ::-1], width)


def _jpeg(image: Any, width: int) -> bytes:
    """JPEG of an image (H, W, 3) uint8 BGR, averaged down to a width."""
    import cv2

    if image.shape[1] > width:
        height = max(1, round(image.shape[0] * width / image.shape[1]))
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 82])[1].tobytes()


def answer(task: dict[str, Any]) -> dict[str, Any]:
    """Do a task: `kind` is "facts", "picture" or "frame"; a picture is written to `out`."""
    from gsba.disk import write_bytes
    from gsba.inspection import inspect

    try:
        path = Path(task["path"])
        if task["kind"] == "facts":
            return inspect(path).table()
        if task["kind"] == "frame":
            content = frame_of(path, task["frame"], task["width"])
        else:
            content = picture_of(path, task["width"], task["share"])
        write_bytes(Path(task["out"]), content)
    except GsbaError as error:
        return {"error": str(error)}
    except Exception as error:
        return {"error": f"{task.get('path')} cannot be read: {brief(str(error), 200)}"}
    return {}


def main() -> None:
    """Answer the tasks of standard input until it ends."""
    import cv2

    os.nice(10)  # runs come first
    cv2.setNumThreads(1)
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # words of libraries are no answers
    for line in sys.stdin:
        print(json.dumps(answer(json.loads(line))), file=answers, flush=True)


if __name__ == "__main__":
    main()
