"""Settings: one frozen model per stage, defaults that run a sensible job with no file."""

import os
from importlib.metadata import EntryPoint, entry_points
from itertools import pairwise
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, PrivateAttr, model_validator

_MAX_FACE_PX = 16_384  # OpenCV's remap takes at most 32,767 pixels across
_MAX_SEED = 2**31 - 1
_CutSize = Annotated[int, Field(ge=64, le=_MAX_FACE_PX)]
_Text = Annotated[str, Field(min_length=1, pattern=r"^[^\x00]*$")]


class _Settings(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class ReadSettings(_Settings):
    """Frames, trajectory and their association in time."""

    trajectory_format: _Text | None = None  # convention of trajectories, see `--trajectory-format`
    clock_offset_s: float | None = None  # s to add to frame times; None = clocks agree or one fits
    clock: Literal["auto", "given"] = "auto"  # auto: an offset is estimated from the camera's
    # rotation, and applied where it is certain


class VideoSettings(_Settings):
    """Frames extracted from a video."""

    fps: float = Field(default=1.0, ge=1e-6, le=1e6)  # frames kept per second
    every: int | None = Field(default=None, ge=1, le=10**9)  # keep one of so many frames instead
    at: _Text | None = None  # trajectory file: keep the frames at its times instead
    sharpest: bool = False  # keep the sharpest frame of each interval; else the first
    from_s: float | None = Field(default=None, ge=0)  # seconds after the first frame
    to_s: float | None = Field(default=None, gt=0)
    width: int | None = Field(default=None, ge=64, multiple_of=2)  # pixels; None = as the video
    standing_deg: float = Field(
        default=0.1, ge=0
    )  # frames that moved less than this since the last kept one are dropped; 0 = keep all


class OdometrySettings(_Settings):
    """Odometry of a video, and the frames that are chosen by it."""

    step: float = Field(
        default=0.2, gt=0, le=1
    )  # baseline of successive chosen frames, relative to the scene's depth
    max_frames: int | None = Field(default=None, ge=3)  # most chosen frames, by longer steps; None
    # = no limit
    fetch_rounds: int = Field(default=3, ge=0)  # rounds that add frames of the video where the map
    # of the chosen frames is weak; 0 = add none


class CubemapSettings(_Settings):
    """Faces cut from a panorama for detection."""

    oversampling: float = Field(default=0.5, ge=0.25, le=4)  # face pixels per panorama pixel
    min_face_size: _CutSize = 192  # pixels; equal bounds set the size
    max_face_size: _CutSize = 448


class FeatureSettings(_Settings):
    """Keypoints on faces."""

    extractor: Literal["sift", "aliked", "disk", "xfeat", "superpoint"] = "sift"
    weights: _Text | None = None  # of a learned extractor: file, or folder with the official file
    accept_noncommercial: bool = False  # use weights whose licence forbids commercial use
    download: bool = False  # fetch missing weights from their authors
    max_per_face: int = Field(default=450, ge=16)
    contrast_threshold: float = Field(default=0.02, gt=0)


class WeakFrameSettings(_Settings):
    """Frames that get more keypoints, because their first keypoints constrain the map weakly."""

    mode: Literal["auto", "measured", "off"] = "auto"  # measured: only where the map turns out to
    # be weak; auto: also where few pairs foretell it; off: all frames get the same number
    max_drift: float = Field(
        default=1.1e-4, gt=0
    )  # predicted position error relative to the path; maps below it get no more keypoints
    max_per_face: int = Field(default=1200, ge=16)


class MatchingSettings(_Settings):
    """Descriptor matching, guided by predicted poses."""

    matcher: Literal["guided", "lightglue", "superglue"] = "guided"
    weights: _Text | None = None  # of a learned matcher: file, or folder with the official file


class PairSettings(_Settings):
    """Frame pairs to match, and the gates around their predicted geometry."""

    window: int = Field(default=32, ge=2)  # frames in time
    max_loop_neighbours: int = Field(default=8, ge=0)  # nearest frames in space outside the window
    strongest_per_face: int = Field(default=150, ge=16)  # keypoints that give pairs' first geometry
    max_tour_frames: int = Field(default=100, ge=0)  # most frames of a tour without a trajectory
    # whose keypoints are searched along epipolar lines, which takes 8 s a step; 0 = never


class RoundSettings(_Settings):
    """Triangulate, adjust, filter."""

    filters: Literal["few", "many"] = "few"  # rounds of filtering: few, as aligned patches follow;
    # many: for features alone
    map_passes: int = Field(default=1, ge=1)  # matching passes after loops are closed

    # Gates of the rounds, in standard deviations of the observations' noise.

    @property
    def dense(self) -> tuple[float, ...]:
        """Gates with matches along the solved chain."""
        return (4.0,) if self.filters == "few" else (6.0, 3.0)

    @property
    def loops(self) -> tuple[float, ...]:
        """Gates with loops closed."""
        return (100.0, 6.0) if self.filters == "few" else (100.0, 20.0, 4.0)

    @property
    def refined(self) -> tuple[float, ...]:
        """Gates with matches along the solved map."""
        return (4.0, 2.5) if self.filters == "few" else (6.0, 3.0, 2.5)


class PatchSettings(_Settings):
    """Patches around the map's points, aligned to every frame that shows them."""

    rounds: int = Field(default=8, ge=0)  # most rounds of alignment and bundle adjustment, which
    # end once the steps between frames no longer change; 0 = none
    max_width: int = Field(default=4096, ge=64)  # pixels across a panorama; wider ones are halved


# Published data of cameras: baseline of the lenses with its standard deviation, millimetres, and
# readout time from the first row to the last one, milliseconds; None = not known.
CAMERAS: dict[str, tuple[tuple[float, float], float | None]] = {
    "dji-osmo-360": ((25.0, 1.5), 24.0),
    "gopro-max": ((30.0, 3.0), None),
    "insta360-one-rs-1inch": ((40.0, 2.0), None),
    "insta360-x3": ((23.0, 1.5), None),
    "insta360-x5": ((32.0, 1.0), 11.8),
}
_RowDirection = Literal["+x", "-x", "+y", "-y"]


class CameraSettings(_Settings):
    """Camera model: two lenses back to back, or more around the camera, and a rolling shutter."""

    model: Literal["auto", "central", "two_lens"] = "auto"  # auto: two lenses where these predict
    # held-out observations better; panoramas only
    name: Literal[tuple(CAMERAS)] | None = None  # type: ignore[valid-type]  # sets both priors below
    lens_yaws_deg: tuple[float, ...] | None = None  # directions in which a panorama's lenses look,
    # from its middle to the right; None = two, front and back, or as a stabiliser turned them
    baseline_mm: float | None = Field(
        default=None, ge=2, le=200
    )  # published baseline of the lenses (the first two of more): gives the metric scale
    readout_ms: float | None = Field(default=None, gt=0, le=200)  # published, first row to last
    sweep: tuple[_RowDirection, _RowDirection] | None = None  # row directions of the front and the
    # back lens, x right and y down in the panorama's middle; None = estimated
    stitch_radius_m: Annotated[float, Field(gt=0, allow_inf_nan=False)] | Literal["far"] | None = (
        None  # distance at which both lenses' images match at the seam; None = estimated
    )

    @model_validator(mode="after")
    def _all_around(self) -> "CameraSettings":
        if self.lens_yaws_deg is None:
            return self
        yaws = sorted(yaw % 360 for yaw in self.lens_yaws_deg)
        gaps = [after - before for before, after in pairwise([*yaws, *(y + 360 for y in yaws[:1])])]
        # a fisheye covers about 200 degrees
        if len(yaws) < 2 or not (min(gaps) >= 10 and max(gaps) <= 190.0):
            raise ValueError("lens_yaws_deg: give the lenses' angles, e.g. [0, 120, 240]")
        if self.sweep is not None:
            raise ValueError("sweep is for two lenses, front and back: leave lens_yaws_deg out")
        return self

    @model_validator(mode="after")
    def _measured(self) -> "CameraSettings":
        if isinstance(self.stitch_radius_m, float) and self.baseline() is None:
            raise ValueError(
                "stitch_radius_m is in metres, but nothing gives the map a metric scale: "
                "give camera.baseline_mm or camera.name as well"
            )
        return self

    def inverse_stitch_radius(self, front: float) -> float | None:
        """Inverse of the given stitch radius; 0 = far, None = not given. `front`: distance of the
        front lens from the rig's centre, map units; the result is in their inverse."""
        baseline = self.baseline()
        if not isinstance(self.stitch_radius_m, float) or baseline is None:
            return None if self.stitch_radius_m is None else 0.0
        return baseline[0] / (2 * front * self.stitch_radius_m)

    def baseline(self) -> tuple[float, float] | None:
        """Baseline of the lenses and its standard deviation, metres; None = not known."""
        if self.baseline_mm is not None:
            return 1e-3 * self.baseline_mm, 0.0
        if self.name is None:
            return None
        length, sigma = CAMERAS[self.name][0]
        return 1e-3 * length, 1e-3 * sigma

    def readout(self) -> tuple[float, float] | None:
        """Published readout time and its standard deviation, seconds; None = not known."""
        ms = self.readout_ms
        if ms is None and self.name is not None:
            ms = CAMERAS[self.name][1]
        # A published readout time differs between a camera's modes, by a sigma of a tenth.
        return None if ms is None else (1e-3 * ms, 1e-3 * 0.1 * ms)

    def untimed(self) -> "CameraSettings":
        """Settings without a readout time, for frames whose timestamps give only their order."""
        known = self.baseline()
        length = {} if known is None else {"baseline_mm": 1e3 * known[0]}
        return self.model_copy(update={"name": None, "readout_ms": None, **length})


class StitchingSettings(_Settings):
    """Stitching field: smooth offsets of bearings on the sphere, shared by all frames."""

    mode: Literal["auto", "off"] = "auto"  # auto: applied where it predicts held-out observations


# Noise of the steps of a usual trajectory: half of a degree, and a tenth of the step.
_STEP_ROTATION_DEG, _STEP_TRANSLATION = 0.5, 0.1


class PriorSettings(_Settings):
    """Noise of the trajectory's steps and poses, as priors of the graph."""

    scale: float = Field(default=1.0, gt=0)  # times the noise of a usual trajectory

    @property
    def rotation_deg(self) -> float:
        """Noise of a step's rotation, degrees."""
        return self.scale * _STEP_ROTATION_DEG

    @property
    def translation(self) -> float:
        """Noise of a step's translation, part of the step."""
        return self.scale * _STEP_TRANSLATION

    def faint(self) -> "PriorSettings":
        """Priors ten times as loose: they only hold steps that images do not constrain."""
        return self.model_copy(update={"scale": 10 * self.scale})


class SolverSettings(_Settings):
    """Bundle adjustment on this machine."""

    num_threads: int | None = Field(default=None, ge=1)  # None = all cores
    part_frames: int | None = Field(default=None, ge=2)  # of a part of a map; None = by memory

    def threads(self) -> int:
        """Number of threads to use."""
        return self.num_threads or os.cpu_count() or 1


class SplatFactorSettings(_Settings):
    """Poses refined against a splat of their own frames; see also `SplatSettings`."""

    sizes: tuple[Annotated[int, Field(ge=16, le=_MAX_FACE_PX)], ...] = Field(
        default=(48, 96), min_length=1
    )  # pixels of a face, in order
    backend: Literal["auto", "gsplat", "cpu"] = "auto"


_TrainingFormat = Literal["colmap", "colmap-flat", "colmap-erp", "nerfstudio"]
# Formats that can store each kind of image other than cube faces.
FORMATS_OF: dict[str, tuple[str, ...]] = {
    "fisheye": ("colmap", "colmap-flat", "nerfstudio"),
    "panorama": ("colmap-erp", "nerfstudio", "opensfm", "metashape", "gltf", "tum"),
}


class ExportSettings(_Settings):
    """Datasets written at the end of a run."""

    formats: tuple[Literal[_TrainingFormat, "opensfm", "metashape", "gltf", "ply", "tum"], ...] = (
        "colmap",
    )
    face_size: int | None = Field(
        default=None, ge=16, le=_MAX_FACE_PX
    )  # pixels; None = a quarter of the panorama's width
    images: Literal["auto", "cube", "lenses", "fisheye", "panorama"] = "auto"  # cube: six faces of
    # one centre; lenses: ten faces of one lens each, where two lenses were found; fisheye: the raw
    # fisheyes; panorama: stitched at the map's depth; auto: lenses of raw fisheyes, else cube
    fetched: bool = False  # datasets also hold the frames that were added where the map was weak

    @model_validator(mode="after")
    def _images_fit(self) -> "ExportSettings":
        fitting = FORMATS_OF.get(self.images, self.formats)
        for name in self.formats:
            if name not in fitting:
                choices = ", ".join(fitting)
                raise ValueError(f"images = {self.images} goes with {choices}, not with {name}")
        return self


class SplatSettings(_Settings):
    """Training of a Gaussian splat."""

    iterations: int = Field(default=7000, ge=1, le=10**7)  # training steps of one view each
    face_size: int = Field(default=256, ge=16, le=_MAX_FACE_PX)  # pixels
    backend: Literal["auto", "gsplat", "cpu"] = "auto"
    max_gaussians: int | None = Field(default=None, ge=1)  # None = set by pixels and memory


class GpsSettings(_Settings):
    """GPS positions of frames, and their noise."""

    file: _Text | None = None  # CSV, GPX, a video, or "exif" of the frames: for the gps factors
    sigma_m: float = Field(
        default=3.0, gt=0
    )  # horizontal standard deviation per axis, metres: floor for all fixes, times DOP where given
    sigma_up_m: float = Field(default=5.0, gt=0)  # vertical standard deviation, metres
    offset_s: float = 0.0  # seconds, added to the times of a file to give the frames' clock


class PlacementSettings(_Settings):
    """World of exports: upright, metric, georeferenced; the run's own world stays unchanged."""

    up: Literal["auto", "none"] = "none"  # auto: gravity from rigs and vertical edges
    length: Annotated[float, Field(gt=0)] | Literal["lens"] | None = None  # metres between the two
    # ends of `between`; "lens": scale from the baseline of the lenses
    between: tuple[str, str] | None = None  # frames by name, or points "x,y,z" of the run's world
    gps: _Text | None = None  # CSV, GPX, a video, or "exif": export in metres, east-north-up
    align: _Text | None = None  # TUM file of true poses: export in its world and unit
    scan: _Text | None = None  # PLY, PCD, LAS, LAZ, OBJ or GLB: export in its world and unit
    pairs: _Text | None = None  # file of three or more pairs of points that start the scan's fit


BUILT_IN = {  # families of gsba
    "bearing": "angles to points on the sphere",
    "reprojection": "pixels of points on cube faces",
    "gps": "positions of frames, from --gps",
    "photometric": "grey values of patches in other frames",
    "splat": "pixels of a Gaussian splat trained on the frames",
}


def installed_families() -> dict[str, EntryPoint]:
    """Entry points of families that packages provide, by name: see `gsba.Family`."""
    return {point.name: point for point in entry_points(group="gsba.families")}


class RefineSettings(_Settings):
    """All settings of a run."""

    video: VideoSettings = VideoSettings()
    odometry: OdometrySettings = OdometrySettings()
    read: ReadSettings = ReadSettings()
    cubemap: CubemapSettings = CubemapSettings()
    features: FeatureSettings = FeatureSettings()
    weak_frames: WeakFrameSettings = WeakFrameSettings()
    matching: MatchingSettings = MatchingSettings()
    pairs: PairSettings = PairSettings()
    priors: PriorSettings = PriorSettings()
    rounds: RoundSettings = RoundSettings()
    patches: PatchSettings = PatchSettings()
    camera: CameraSettings = CameraSettings()
    stitching: StitchingSettings = StitchingSettings()
    solver: SolverSettings = SolverSettings()
    factors: tuple[str, ...] = ("bearing",)  # BUILT_IN, and of packages by NAME or NAME:ARGUMENT
    gps: GpsSettings = GpsSettings()
    splat: SplatFactorSettings = SplatFactorSettings()
    export: ExportSettings = ExportSettings()
    placement: PlacementSettings = PlacementSettings()
    seed: int = Field(default=0, ge=0, le=_MAX_SEED)

    _gate_factor: float = PrivateAttr(
        1.0
    )  # no setting: a run knows how well its lenses are calibrated

    def direct_families(self) -> tuple[str, ...]:
        """Families that compare pixels of whole frames."""
        return tuple(name for name in self.factors if name in ("photometric", "splat"))

    def package_families(self) -> tuple[str, ...]:
        """Families that packages provide."""
        return tuple(name for name in self.factors if name not in BUILT_IN)

    def with_gates(self, scale: float) -> "RefineSettings":
        """Settings with matching gates `scale` times as wide, for poorly calibrated lenses."""
        wider = self.model_copy()
        wider._gate_factor = scale * self._gate_factor
        return wider

    @property
    def gate_factor(self) -> float:
        """Factor on angular matching gates; see `with_gates`."""
        return self._gate_factor

    def with_faint_priors(self) -> "RefineSettings":
        """Settings with loose priors, for a trajectory that only gives initial poses."""
        return self.model_copy(update={"priors": self.priors.faint()})

    def plainer(self) -> "RefineSettings":
        """Settings of a first solution: features alone, without patches, pixels or splats."""
        unaligned = self.patches.model_copy(update={"rounds": 0})
        families = tuple(name for name in self.factors if name not in self.direct_families())
        return self.model_copy(update={"patches": unaligned, "factors": families})

    @model_validator(mode="after")
    def _geometry_first(self) -> "RefineSettings":
        for name in self.package_families():
            known = (*BUILT_IN, *installed_families())
            if name.partition(":")[0] not in known:
                listed = ", ".join(f'"{one}"' for one in known)
                raise ValueError(f'factors: "{name}" is not installed; installed are {listed}')
        own = {"bearing", "reprojection"} & set(self.factors)
        if not own and not self.package_families() and self.factors:
            named = " and ".join(self.factors)
            raise ValueError(f"factors: {named} needs bearing or reprojection as well; add one")
        return self

    @model_validator(mode="after")
    def _gps_has_fixes(self) -> "RefineSettings":
        if "gps" in self.factors and self.gps.file is None:
            raise ValueError("factors: gps needs positions: pass --gps FILE, or gps.file")
        if "gps" not in self.factors and self.gps.file is not None:
            raise ValueError("gps.file is read by the gps factors: add gps to factors")
        return self

    @model_validator(mode="after")
    def _one_family(self) -> "RefineSettings":
        matcher, extractor = self.matching.matcher, self.features.extractor
        fitting = {
            "lightglue": ("aliked", "disk", "xfeat", "superpoint"),
            "superglue": ("superpoint",),
        }.get(matcher, (extractor,))
        if extractor not in fitting:
            choices = ", ".join(fitting)
            raise ValueError(f"matching.matcher = {matcher} needs features.extractor = {choices}")
        return self
