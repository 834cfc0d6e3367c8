"""A user's segmentation model: a command or a Python callable that masks faces.

Each frame is cut into faces of 90 degrees; the model masks them (white = use), and the masks are
put back onto the sphere.
"""

import functools
import shlex
import shutil
import subprocess
import uuid
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from factors.threads import Once
from gsba.camera.rig import CubeRig, owner_faces
from gsba.camera.sphere import erp_directions
from gsba.disk import disk_errors, write_image
from gsba.frames import cubemap
from gsba.frames.files import decode, image_size
from gsba.log import GsbaError, track
from gsba.store.store import PerFrame, RunStore, fingerprint
from gsba.types import FACES, FrameSet, PictureFormat

Segment = str | Callable[[np.ndarray], np.ndarray]
"""A command line, or a function from a face (N, N, 3) uint8 RGB to (N, N) bool, True = use."""

_MAX_FACE_PX = 1024  # pixels
_PLACEHOLDERS = ("{image}", "{mask}", "{images}", "{masks}")


@dataclass(frozen=True, slots=True)
class Segmented:
    """Masks of the faces of one frame."""

    bits: np.ndarray  # packed (6, size, size) bool, True = use, in FACES order
    size: int  # pixels


def segmented(store: RunStore, frames: FrameSet, segment: Segment) -> PerFrame[Segmented]:
    """Faces' masks by frame name, as stage `segmented` of a run.

    A command is called once, `COMMAND IMAGES MASKS` with two folders: for each PNG of a face it
    must write a mask of the same name and size. `{images}` and `{masks}` in the command stand for
    the folders; `{image}` and `{mask}` make it a call for every face. A callable's results are
    never resumed. Raises GsbaError: the command fails, or a mask is missing or of another size.
    """
    index = {name: f for f, name in enumerate(frames.names)}
    folder = store.root / "stages" / "segmented-faces"
    ask = Once(lambda: _run(str(segment), frames, folder))

    def compute(name: str) -> Segmented:
        present, size = _present(frames.format_of(index[name])), _size(frames, index[name])
        use = np.ones((len(FACES), size, size), bool)
        if callable(segment):
            faces, _ = cubemap.load(frames, index[name], CubeRig(size, np.pi / 2))
            for c in present:
                use[c] = _checked(segment(faces[c]), size, f"{name}, {FACES[c]}")
        else:
            ask()
            for c in present:
                path = folder / "masks" / _face_file(name, c)
                use[c] = decode(path, (size, size), gray=True) > 127
        return Segmented(np.packbits(use), size)

    key = uuid.uuid4().hex if callable(segment) else segment
    items = {
        name: (fingerprint(frames.paths[f]), frames.format_of(f).fisheyes, _size(frames, f))
        for name, f in index.items()
    }
    found = store.per_frame("segmented", key, items, compute, Segmented, alone=True)
    shutil.rmtree(folder, ignore_errors=True)
    return found


def load_segmented(found: PerFrame[Segmented], frames: FrameSet, frame: int) -> np.ndarray:
    """Mask of a frame, (h, 2h) bool as dense as the faces."""
    one = found[frames.names[frame]]
    use = np.unpackbits(one.bits, count=len(FACES) * one.size**2) > 0
    return use[_places(one.size)]


def _size(frames: FrameSet, frame: int) -> int:
    """Pixels across the faces of a frame."""
    return cubemap.native_rig(frames.format_of(frame), _MAX_FACE_PX).size


def _face_file(name: str, face: int) -> str:
    """File name of a frame's face; folders are flat, whatever recordings the frames are of."""
    return f"{name.replace('/', '@')}_{FACES[face]}.png"


def _present(kind: PictureFormat) -> list[int]:
    """Faces that frames of a camera have."""
    return [FACES.index(face) for face in kind.faces] or list(range(len(FACES)))


def _run(command: str, frames: FrameSet, folder: Path) -> None:
    """Write all faces, call the command, and check that it has masked them."""
    images, masks = folder / "images", folder / "masks"
    shutil.rmtree(folder, ignore_errors=True)
    with disk_errors(folder):
        images.mkdir(parents=True)
        masks.mkdir()
    sizes: dict[str, int] = {}  # pixels across each face
    for f, name in enumerate(track(frames.names, "cutting faces")):
        kind = frames.format_of(f)
        rig = cubemap.native_rig(kind, _MAX_FACE_PX)
        faces, _ = cubemap.load(frames, f, rig)
        for c in _present(kind):
            sizes[_face_file(name, c)] = rig.size
            write_image(images / _face_file(name, c), faces[c])
    names = list(sizes)
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise GsbaError(f"--segment {command}: {error}") from None
    if not words:
        raise GsbaError("--segment: no command given")
    if any("{image}" in word or "{mask}" in word for word in words):
        for name in track(names, "segmenting"):
            _call(words, {"{image}": images / name, "{mask}": masks / name}, command)
    else:
        if not any(field in word for word in words for field in _PLACEHOLDERS):
            words = [*words, "{images}", "{masks}"]
        _call(words, {"{images}": images, "{masks}": masks}, command)
    missing = [name for name in names if not (masks / name).is_file()]
    if missing:
        raise GsbaError(
            f"--segment {command}: wrote no mask {missing[0]} ({len(missing)} of {len(names)} "
            "missing): it must write one of each face's name"
        )
    for name, size in sizes.items():
        width, height = image_size(masks / name)
        if (width, height) != (size, size):
            raise GsbaError(
                f"--segment {command}: mask {name} is {width}x{height}, its face is {size}x{size}"
            )


def _call(words: list[str], values: dict[str, Path], command: str) -> None:
    """Run a command without a shell; refuse its failure with its last line."""
    filled = []
    for word in words:
        for field, value in values.items():
            word = word.replace(field, str(value.resolve()))
        filled.append(word)
    try:
        done = subprocess.run(filled, capture_output=True, text=True, errors="replace", check=False)
    except OSError as error:
        raise GsbaError(f"--segment {command}: cannot be run ({error.strerror})") from None
    if done.returncode:
        last = (done.stderr.strip() or done.stdout.strip() or "it printed nothing").splitlines()[-1]
        raise GsbaError(f"--segment {command}: failed with exit code {done.returncode}: {last}")


def _checked(mask: np.ndarray, size: int, where: str) -> np.ndarray:
    """A callable's mask, checked."""
    mask = np.asarray(mask)
    if mask.shape != (size, size) or mask.dtype != bool:
        raise GsbaError(
            f"segment: mask of {where} is {mask.dtype} of shape {mask.shape}; a face's mask is "
            f"bool of shape {(size, size)}, True = use"
        )
    return mask


@functools.lru_cache(maxsize=4)
def _places(size: int) -> np.ndarray:
    """Index (2 size, 4 size) int64 into flat faces of each panorama pixel."""
    bearings = erp_directions(4 * size)
    owners = owner_faces(bearings)
    pixels = CubeRig(size, np.pi / 2).project(bearings, owners)
    u, v = np.clip(np.moveaxis(pixels, -1, 0).astype(np.int64), 0, size - 1)
    return (owners.astype(np.int64) * size + v) * size + u
