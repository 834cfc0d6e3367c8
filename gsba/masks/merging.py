"""The masks of a run: given ones, and those found before and after the first solution, merged.

White = use. Found masks are written to the run's folder; features, patches, splats and exports then
read these files like given masks.
"""

import logging
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

from gsba.disk import encoded_image, write_bytes, write_image
from gsba.frames.masks import levels_of, load_mask, load_weights
from gsba.frames.pixels import load_erp
from gsba.log import GsbaError, track
from gsba.masks.borders import Borders, find_borders, padded
from gsba.masks.carrier import Carrier, carrier_mask, find_carrier, marked, no_carrier
from gsba.masks.distractors import Distractors, KnownMasks, Look, StaticScene, distractor_weights
from gsba.masks.segmentation import Segment, load_segmented, segmented
from gsba.store.store import PerFrame, RunStore, fingerprint
from gsba.types import Counts, FrameSet, Solution

logger = logging.getLogger(__name__)

AUTO, CARRIER, DISTRACTORS, NONE = "auto", "carrier", "distractors", "none"  # values of --masks
# beside a file
Masks = Path | str | Sequence[Path | str] | None
_FOLDER = "masks"
_NUM_CHECK_FRAMES, _CHECK_WIDTH_PX = 6, 768  # frames in the check picture, and its width in pixels


@dataclass(frozen=True, slots=True)
class Choice:
    """The sources of masks."""

    given: Path | None  # file or folder
    carrier: bool
    distractors: bool
    segment: Segment | None
    carrier_required: bool = False  # True if an undetectable carrier is an error
    recordings: Mapping[str, "Choice"] = field(default_factory=dict)  # of each of several

    @classmethod
    def joined(cls, choices: Mapping[str, "Choice"]) -> "Choice":
        """The choices of several recordings, by name. Files belong to each recording alone."""
        each = choices.values()
        return cls(
            None,
            any(one.carrier for one in each),
            any(one.distractors for one in each),
            next((one.segment for one in each), None),
            any(one.carrier_required for one in each),
            choices,
        )

    def of(self, recording: str) -> "Choice":
        """The choice of one of several recordings, or that of all frames."""
        return self.recordings.get(recording, self)


def choose(masks: Masks, segment: Segment | None = None) -> Choice:
    """The sources of masks that `--masks` (a file or a folder, "auto", "carrier", "distractors", or
    several of these; "none" or None = no masks) and `--segment` (see `gsba.masks.segmentation`)
    name. "carrier" is "auto" that fails if the carrier cannot be detected. GsbaError: two files or
    folders, or "none" with others."""
    values = [masks] if isinstance(masks, Path | str) else list(masks or ())
    words = {str(value) for value in values} & {AUTO, CARRIER, DISTRACTORS, NONE}
    files = [Path(value) for value in values if str(value) not in words]
    if len(files) > 1:
        raise GsbaError(f"--masks {files[0]} and {files[1]}: give one file or one folder")
    if NONE in words and len(values) > 1:
        raise GsbaError("--masks none turns masks off: leave the other --masks out")
    return Choice(
        files[0] if files else None,
        bool(words & {AUTO, CARRIER}),
        DISTRACTORS in words,
        segment,
        CARRIER in words,
    )


def before(store: RunStore, frames: FrameSet, choice: Choice) -> FrameSet:
    """Frames with masks known before any solution: segmentation, black borders, the carrier.
    GsbaError: a segmentation fails; or the carrier is required and cannot be detected."""
    parts: list[Callable[[int], np.ndarray | None]] = []
    names = []
    if choice.segment is not None:
        found = segmented(store, frames, choice.segment)
        parts.append(lambda f: load_segmented(found, frames, f))
        names.append("segmented")
    for name, mask in _borders(store, frames, choice).items():
        parts.append(mask)
        names.append(name)
    if choice.carrier:
        frames, more, stages = _carriers(store, frames, choice, alone=not parts)
        parts += more
        names += stages
    if not parts:
        return frames
    final = not choice.distractors
    folder = store.root / (_FOLDER if final else f"stages/first-{_FOLDER}")
    return _merge(store, folder, frames, parts, names)


def _borders(
    store: RunStore, frames: FrameSet, choice: Choice
) -> dict[str, Callable[[int], np.ndarray | None]]:
    """Masks of areas that are black in all frames of a recording, by the name of their stage."""
    parts: dict[str, Callable[[int], np.ndarray | None]] = {}
    for name, (rows, own) in _by_recording(frames).items():
        if not (choice.of(name).carrier or padded(own)):
            continue
        found = find_borders(own)
        if not found.share:
            continue
        stage = f"borders@{name}" if name else "borders"
        files = fingerprint(path for group in own.paths for path in group)
        store.stage(stage, files, lambda found=found: found, Borders)
        logger.info("%s: %.1f%% of the picture is black in all frames", stage, 100 * found.share)
        within = frozenset(map(int, rows))
        parts[stage] = lambda f, found=found, within=within: found.mask if f in within else None
    return parts


def _carriers(
    store: RunStore, frames: FrameSet, choice: Choice, alone: bool
) -> tuple[FrameSet, list[Callable[[int], np.ndarray | None]], list[str]]:
    """Frames with the mask of each recording's carrier, or else parts of masks and their stages."""
    recordings = _by_recording(frames)
    stages = {name: _carrier_stage(name) for name in recordings}
    found: dict[str, Carrier] = {}
    for name, (_, own) in recordings.items():
        if choice.of(name).carrier:
            carrier = _carrier(store, own, choice.of(name).carrier_required, stages[name])
            if carrier.share:
                found[name] = carrier
    turning = any(carrier.turns.any() for carrier in found.values())
    if alone and not (turning or any(frames.mask_paths)):
        paths = [name.rpartition("/")[0] for name in frames.names]
        masks = [store.root / f"{stages[name]}.png" if name in found else None for name in paths]
        return replace(frames, mask_paths=tuple(masks)), [], []
    first = {name: int(rows[0]) for name, (rows, _) in recordings.items()}

    def part(f: int) -> np.ndarray | None:
        name = frames.names[f].rpartition("/")[0]
        if name not in found:
            return None
        return carrier_mask(found[name], frames.format_of(f), f - first[name])

    return frames, [part] if found else [], [stages[name] for name in found]


def after(
    store: RunStore, frames: FrameSet, choice: Choice, solved: Solution, stage: str
) -> tuple[FrameSet, Counts]:
    """Frames with masks of pixels that no static scene explains, by a first solution and its stage.
    Distractors are searched twice: the second pass does not compare pixels that the first one
    marked in other frames. Frames of recordings that do not ask for them are compared alone."""
    items = dict.fromkeys(frames.names)

    def look(name: str, before: PerFrame[Distractors] | None) -> PerFrame[Distractors]:
        known = None if before is None else KnownMasks(before, frames.names)
        scene = StaticScene(frames, solved.world_T_rigs, solved.landmarks, known)
        compute = Look(scene, {frame: f for f, frame in enumerate(frames.names)})
        behind = [stage] if known is None else ["distractors1"]
        return store.per_frame(name, None, items, compute, Distractors, behind)

    found = look("distractors", look("distractors1", None))
    asking = {
        f: name
        for f, name in enumerate(frames.names)
        if choice.of(name.rpartition("/")[0]).distractors
    }
    results = {f: found[name] for f, name in asking.items()}
    parts = [lambda f: distractor_weights(results[f]) if f in results else None]
    merged = _merge(store, store.root / _FOLDER, frames, parts, ["distractors"], [*asking.values()])
    shares, rows_of = np.array([one.share for one in results.values()]), np.array([*results])
    check = store.root / "masks_check.jpg"
    if not (check.exists() and store.records["masks"].resumed):
        rows = []
        for row in np.sort(rows_of[np.argsort(-shares, kind="stable")[:_NUM_CHECK_FRAMES]]):
            size = (_CHECK_WIDTH_PX, _CHECK_WIDTH_PX // 2)
            if merged.format_of(int(row)).panoramic:
                shown = cv2.resize(load_erp(merged, int(row), width=_CHECK_WIDTH_PX), size)
            else:
                shown = np.full((size[1], size[0], 3), 128, np.uint8)
            mask = load_mask(merged, int(row))
            assert mask is not None
            shown = marked(shown, _fit(mask, _CHECK_WIDTH_PX) == 0)
            place = (6, size[1] - 8)
            cv2.putText(shown, merged.names[row], place, cv2.FONT_HERSHEY_PLAIN, 1, (255, 255, 255))
            rows.append(shown)
        write_image(check, np.concatenate(rows), jpeg_quality=88)
    store.claim(check)
    reasons = [one.reason.partition(":")[0] for one in results.values() if one.reason]
    for f, one in results.items():
        if one.reason:
            logger.warning("%s: not searched for distractors: %s", asking[f], one.reason)
    logger.info("distractors: %.1f%% of the pictures", 100 * shares.mean())
    dropped = {reason: reasons.count(reason) for reason in dict.fromkeys(reasons)}
    return merged, Counts(len(results), len(results) - len(reasons), "frames", dropped)


def recut(store: RunStore, frames: FrameSet, cut: int, cameras: Collection[int]) -> FrameSet:
    """Raw pairs, with masks of an earlier cut, of which those of `cameras` are cut anew by a better
    calibration, the `cut`-th from 1: the carrier of each of their recordings is detected again.
    Masks of anything else are kept."""
    masks = list(frames.mask_paths)
    for recording, (rows, own) in _by_recording(frames).items():
        earlier = {store.root / f"{_carrier_stage(recording, n)}.png" for n in range(cut)}
        camera = frames.camera_of_frame[rows[0]] if frames.camera_of_frame else 0
        if camera not in cameras or not {masks[f] for f in rows} <= earlier:
            continue
        name = _carrier_stage(recording, cut)
        path = store.root / f"{name}.png" if _carrier(store, own, False, name).share else None
        for f in rows:
            masks[f] = path
    return replace(frames, mask_paths=tuple(masks))


def _by_recording(frames: FrameSet) -> dict[str, tuple[np.ndarray, FrameSet]]:
    """Rows (R,) and frames of each recording by its name; "" = there is only one."""
    several = {name: (rows, frames.taken(rows)) for name, rows in frames.recordings.items()}
    return several or {"": (np.arange(len(frames)), frames)}


def _carrier_stage(recording: str, cut: int = 0) -> str:
    """Name of the stage that detects the carrier of a recording, "" = the only one, in frames of
    the `cut`-th cut."""
    return f"carrier{cut or ''}{recording and '@'}{recording}"


def _carrier(store: RunStore, frames: FrameSet, required: bool, name: str) -> Carrier:
    """The carrier as stage `name`, and its pictures in the run's folder if there is one."""

    def compute() -> Carrier:
        try:
            return find_carrier(frames)
        except GsbaError as error:
            if required:
                raise
            logger.info("no carrier is masked: %s", error)
            return no_carrier(frames, str(error))

    files = fingerprint(path for group in frames.paths for path in group)
    found = store.stage(name, (files, frames.format.fisheyes, required), compute, Carrier)
    if not found.share:
        return found
    path, check = store.root / f"{name}.png", store.root / f"{name}_check.jpg"
    mask = encoded_image(carrier_mask(found, frames.format, 0).astype(np.uint8) * 255, path)
    known = path.exists() and path.read_bytes() == mask
    if not known:  # a new file would invalidate all stages
        write_bytes(path, mask)
    if not (known and check.exists() and store.records[name].resumed):
        write_image(check, marked(found.median, ~found.mask), jpeg_quality=88)
    for written in (path, check):
        store.claim(written)
    return found


def _merge(
    store: RunStore,
    folder: Path,
    frames: FrameSet,
    parts: Sequence[Callable[[int], np.ndarray | None]],
    stages: Sequence[str],
    known: object = None,
) -> FrameSet:
    """Frames with masks `folder`/NAME.png of own masks and all parts ((h, 2h) bool, weights, None),
    which the results of stages and what else is `known` make; an unchanged file keeps its time, so
    that stages that depend on it resume."""
    paths = [folder / f"{name}.png" for name in frames.names]

    def compute() -> Counts:
        masked = 0
        for f, path in enumerate(track(paths, "writing masks")):
            weights = load_weights(frames, f)
            if weights is None:
                width = frames.format_of(f).panorama_width
                weights = np.ones((width // 2, width), np.float32)
            for part in parts:
                found = part(f)
                if found is not None:
                    weights = weights * _fit(found, weights.shape[1])
            encoded = cv2.imencode(".png", levels_of(weights))[1].tobytes()
            if not (path.exists() and path.read_bytes() == encoded):
                write_bytes(path, encoded)
            masked += not weights.all()
        return Counts(len(paths), masked, "masks", {"nothing masked": len(paths) - masked})

    name = "masks" if folder.parent == store.root else "first-masks"
    if not all(path.exists() for path in paths):
        store.forget(name)
    shapes = [(kind.width, kind.layout) for kind in frames.formats]
    inputs = fingerprint(frames.mask_paths), shapes, frames.camera_of_frame, known
    store.stage(name, inputs, compute, Counts, stages)
    if name == "masks":
        store.claim(folder)
    return replace(frames, mask_paths=tuple(paths))


def _fit(weights: np.ndarray, width: int) -> np.ndarray:
    """Weights (h, 2h) 0..1, or bool, at another width, their outline smooth, as float32."""
    values = weights.astype(np.float32)
    if values.shape[1] == width:
        return values
    size = (width, width // 2)
    values, inside = (cv2.resize(part, size) for part in (values, (values > 0).astype(np.float32)))
    return np.where(inside > 0.5, values / np.maximum(inside, 0.5), 0)
