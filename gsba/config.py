"""Settings: one frozen model per stage, defaults that run a sensible job with no file."""

import os
from importlib.metadata import EntryPoint, entry_points
from typing import Annotated, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

_MAX_FACE, _MAX_SEED = 16_384, 2**31 - 1  # pixels: remapping ends at 32,767
_CutSize = Annotated[int, Field(ge=64, le=_MAX_FACE)]
_Text = Annotated[str, Field(min_length=1, pattern=r"^[^\x00]*$")]


class _Settings(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class ReadSettings(_Settings):
    """Frames, trajectory and their association in time."""

    max_interpolation_s: float = Field(
        default=10.0, gt=0
    )  # longer gaps are still filled, but reported
    clock_offset_s: float | None = None  # s to add to frame times; None = clocks agree or one fits
    clock: Literal["auto", "given"] = "auto"  # auto: corrected by how the camera turns, where sure
    max_clock_shift_s: float = Field(default=10.0, gt=0, le=600)  # most that is corrected


class VideoSettings(_Settings):
    """Frames taken from a video, where one is given in their place."""

    fps: float = Field(default=1.0, ge=1e-6, le=1e6)  # frames kept per second
    every: int | None = Field(default=None, ge=1, le=10**9)  # keep one of so many frames instead
    at: _Text | None = None  # trajectory file: keep the frames at its times instead
    sharpest: bool = False  # of the frames that one is kept of; else the first
    from_s: float | None = Field(default=None, ge=0)  # seconds after the first frame
    to_s: float | None = Field(default=None, gt=0)
    width: int | None = Field(default=None, ge=64, multiple_of=2)  # pixels; None = as the video
    standing_deg: float = Field(
        default=0.1, ge=0
    )  # less apparent motion since the last frame: the camera stands, leave out; 0 = keep all


class OdometrySettings(_Settings):
    """A video's own odometry, and the frames that are chosen by what it shows."""

    width: int = Field(default=800, ge=256, le=4096, multiple_of=2)  # pixels across the panoramas
    step: float = Field(
        default=0.2, gt=0, le=1
    )  # from one chosen frame to the next, part of the distance of things
    max_turn_deg: float = Field(default=40.0, gt=0)  # from one chosen frame to the next
    max_frames: int | None = Field(default=None, ge=3)  # chosen, by longer steps; None = no limit
    fetch_rounds: int = Field(default=3, ge=0)  # in which more frames are fetched, where the map of
    # those that were chosen is weak; 0 = none are
    max_drift: float = Field(
        default=3e-4, gt=0
    )  # predicted error of positions, part of the path; in maps above it, frames are fetched


class CubemapSettings(_Settings):
    """Faces cut from a panorama for detection."""

    hfov_deg: float = Field(default=96.0, ge=90, le=120)
    face_size: _CutSize | None = None  # pixels; None = by oversampling
    oversampling: float = Field(default=0.5, ge=0.25, le=4)  # face pixels per panorama pixel
    min_face_size: _CutSize = 192  # pixels; bounds on the automatic size
    max_face_size: _CutSize = 448


class FeatureSettings(_Settings):
    """Keypoints on faces."""

    extractor: Literal["sift", "aliked", "disk", "xfeat", "superpoint"] = "sift"
    weights: _Text | None = None  # of a learned extractor: file, or folder with the official file
    accept_noncommercial: bool = False  # use weights whose licence forbids commercial use
    download: bool = False  # fetch missing weights from their authors
    max_per_face: int = Field(default=450, ge=16)
    contrast_threshold: float = Field(default=0.02, gt=0)
    sigma_px: float = Field(
        default=0.16, gt=0
    )  # per-axis noise of the smallest keypoints, face pixels
    sigma_per_size: float = Field(
        default=0.033, ge=0
    )  # further noise, as a part of the keypoint's size


class WeakFrameSettings(_Settings):
    """Frames that get more keypoints, because the first of them hold the map poorly."""

    mode: Literal["auto", "off"] = "auto"  # off: all frames alike
    max_drift: float = Field(
        default=1.1e-4, gt=0
    )  # predicted error of positions, part of the path; a map below it is left alone
    max_scale_sigma: float = Field(
        default=8e-4, gt=0
    )  # of a step's length over the one before, relative; above, a place is weak
    reach: int = Field(default=2, ge=0)  # frames before and after such a place
    max_per_face: int = Field(default=1200, ge=16)
    contrast_threshold: float = Field(default=0.01, gt=0)


class MatchingSettings(_Settings):
    """Descriptor matching, guided by predicted poses."""

    matcher: Literal["guided", "lightglue", "superglue"] = "guided"
    weights: _Text | None = None  # of a learned matcher: file, or folder with the official file
    min_similarity: float = Field(default=0.8, ge=-1, le=1)  # cosine of both descriptors
    max_ratio: float = Field(default=0.9, gt=0, le=1)  # distance to the best over that to the next


class GateSettings(_Settings):
    """How far a match may stray from what poses predict."""

    rotation_deg: float = Field(gt=0)  # error of the relative rotation
    direction: float = Field(ge=0)  # tangent of the error of the translation's direction


class PairSettings(_Settings):
    """Which frames are matched, and how closely predictions are believed."""

    window: int = Field(default=32, ge=2)  # frames in time
    max_baseline_depths: float = Field(default=2.0, gt=0)  # longest baseline in median scene depths
    max_loop_neighbours: int = Field(default=8, ge=0)  # nearest frames in space outside the window
    max_parallax_deg: float = Field(default=60.0, gt=0, le=180)
    strongest_per_face: int = Field(default=150, ge=16)  # keypoints that find neighbours' geometry
    scarce_matches: int = Field(default=60, ge=0)  # below, a pair is matched with all keypoints
    least_agreement: float = Field(default=0.5, ge=0, le=1)  # of a step's matches; the same below
    prior: GateSettings = GateSettings(rotation_deg=4.0, direction=0.4)  # coarse trajectory
    loop_deg: float = Field(default=2.0, gt=0)  # around a known point, besides drift
    refined: GateSettings = GateSettings(rotation_deg=0.4, direction=0.005)  # solved map
    point_deg: float = Field(default=0.6, gt=0)  # around the predicted bearing of a known point
    drift: float = Field(
        default=0.003, gt=0
    )  # of the solved chain, part of the path between two frames
    far_drift: float = Field(
        default=0.05, ge=0, le=1
    )  # the same at its worst: no loop may ask for more


class VerifySettings(_Settings):
    """Two-view geometry."""

    max_error_deg: float = Field(default=0.25, gt=0)  # RANSAC inlier threshold
    max_false_alarms: float = Field(
        default=1e-3, gt=0, lt=1
    )  # expected number of poses of a pair that chance explains as well as the one believed
    max_error_rate: float = Field(
        default=0.05, gt=0, lt=1
    )  # of preferring one of two poses that explain matches equally well
    max_rotation_deg: float = Field(default=6.0, gt=0)  # disagreement with the trajectory
    max_direction_deg: float = Field(default=20.0, gt=0)  # disagreement with the trajectory
    max_length_ratio: float = Field(default=1.5, gt=1)  # disagreement with the trajectory
    max_triplet_deg: float = Field(
        default=3.0, gt=0
    )  # of a pair over two steps off what these allow: true ones are within 1, look-alikes 10 off


class TriangulateSettings(_Settings):
    """Scene points."""

    min_track_length: int = Field(default=2, ge=2)  # observations of a point
    min_parallax_deg: float = Field(default=0.5, gt=0)  # largest angle between two rays of a point


class RoundSettings(_Settings):
    """Triangulate, adjust, filter: gates in standard deviations of the observations' noise."""

    chain: tuple[float, ...] = (60.0, 8.0)  # from the coarse trajectory
    dense: tuple[float, ...] = (4.0,)  # with matches along the solved chain
    loops: tuple[float, ...] = (100.0, 6.0)  # with loops closed
    refined: tuple[float, ...] = (4.0, 2.5)  # with matches along the solved map
    aligned: tuple[float, ...] = (6.0, 3.0)  # with aligned patches
    map_passes: int = Field(default=1, ge=1)  # times the closed map is matched anew
    gate_scale: float = Field(default=10.0, ge=1)  # wider gates loosen the loss in proportion
    tolerance: float = Field(default=3e-4, gt=0, lt=1)  # solver's, in all rounds but a run's last
    min_support: float = Field(
        default=0.99, gt=0, le=1
    )  # observations a round must go on explaining
    min_noise: float = Field(default=0.5, gt=0)  # floor of the estimated noise, in feature sigmas
    min_observations: int = Field(default=12, ge=1)  # of a frame, or it counts as unrefined


class PatchSettings(_Settings):
    """Patches around the map's points, aligned to every frame that shows them."""

    rounds: int = Field(default=2, ge=0)  # of alignment and bundle adjustment; 0 = none
    weak_rounds: int = Field(default=4, ge=0)  # at most, of a map that images hold poorly, until
    # the steps from frame to frame have settled
    patch_size: int = Field(default=15, ge=5, le=41)  # pixels across, odd
    max_width: int = Field(default=4096, ge=64)  # of a panorama; wider ones are halved till under
    max_views: int = Field(default=16, ge=1)  # frames that a point is looked for in
    near_frames: int = Field(default=40, ge=0)  # nearest in space, among which views are found
    min_track_length: int = Field(
        default=3, ge=2
    )  # observations a point needs, unless aligned before, to be looked for in further frames
    max_angle_deg: float = Field(default=45.0, gt=0, lt=90)  # between views of a point
    max_ratio: float = Field(default=1.8, gt=1)  # of a point's distances
    affine_sigma: float = Field(default=0.15, gt=0)  # deviation from a surface facing the viewer
    grey_sigma: float = Field(default=3.0, gt=0)  # noise it is weighed against, grey values
    min_contrast: float = Field(default=2.0, gt=0)  # grey values, standard deviation in a patch
    min_zncc: float = Field(default=0.75, gt=0, lt=1)  # correlation of the aligned patches
    max_shift_px: float = Field(default=3.0, gt=0)  # from the predicted place, panorama pixels
    max_sigma_px: float = Field(default=0.5, gt=0)  # along the worst direction

    @field_validator("patch_size")
    @classmethod
    def _odd(cls, size: int) -> int:
        if size % 2 == 0:
            raise ValueError("must be odd: a patch has a pixel in its middle")
        return size


# What makers and owners say of cameras: millimetres between the lenses' centres with a standard
# deviation, and milliseconds from the first row to the last one; None = not known.
CAMERAS: dict[str, tuple[tuple[float, float], float | None]] = {
    "dji-osmo-360": ((25.0, 1.5), 24.0),
    "gopro-max": ((30.0, 3.0), None),
    "insta360-one-rs-1inch": ((40.0, 2.0), None),
    "insta360-x3": ((23.0, 1.5), None),
    "insta360-x5": ((32.0, 1.0), 11.8),
}
_READOUT_SIGMA = 0.1  # of a duration that is said, part of it: modes of a camera differ
_Way = Literal["+x", "-x", "+y", "-y"]


class CameraSettings(_Settings):
    """Two lenses back to back, each with a centre of its own, read row by row."""

    model: Literal["auto", "central", "two_lens"] = "auto"  # auto: two lenses where they predict
    # what they were not found from; panoramas only
    name: Literal[tuple(CAMERAS)] | None = None  # type: ignore[valid-type]  # for what is said of it
    seam_deg: float = Field(default=4.0, ge=0, le=20)  # from the seam: pictures blended, left out
    baseline_mm: float | None = Field(
        default=None, ge=2, le=200
    )  # between the lenses, as the maker says: tells the metric scale
    readout_ms: float | None = Field(default=None, gt=0, le=200)  # first row to last, as is said
    sweep: tuple[_Way, _Way] | None = None  # which way rows of the front and of the back lens are
    # read, x right and y down in the panorama's middle; None = found
    stitch_radius_m: Annotated[float, Field(gt=0, allow_inf_nan=False)] | Literal["far"] | None = (
        None  # at which both lenses' pictures meet; None = found
    )

    @model_validator(mode="after")
    def _measured(self) -> "CameraSettings":
        if isinstance(self.stitch_radius_m, float) and self.baseline() is None:
            raise ValueError(
                "stitch_radius_m is in metres, which only the distance between the lenses tells: "
                "give camera.baseline_mm or camera.name as well"
            )
        return self

    def inverse_stitch_radius(self, front: float) -> float | None:
        """Inverse of the stitch radius as is said, the front lens `front` from the middle.

        In what that is given in; None = nothing is said.
        """
        baseline = self.baseline()
        if not isinstance(self.stitch_radius_m, float) or baseline is None:
            return None if self.stitch_radius_m is None else 0.0
        return baseline[0] / (2 * front * self.stitch_radius_m)

    def baseline(self) -> tuple[float, float] | None:
        """Metres between the lenses, and their standard deviation."""
        if self.baseline_mm is not None:
            return 1e-3 * self.baseline_mm, 0.0
        if self.name is None:
            return None
        length, sigma = CAMERAS[self.name][0]
        return 1e-3 * length, 1e-3 * sigma

    def readout(self) -> tuple[float, float] | None:
        """Seconds of the readout as is said, and their standard deviation."""
        said = self.readout_ms
        if said is None and self.name is not None:
            said = CAMERAS[self.name][1]
        return None if said is None else (1e-3 * said, 1e-3 * _READOUT_SIGMA * said)


class StitchingSettings(_Settings):
    """What stitching bends, found as a smooth field on the sphere that all frames share."""

    mode: Literal["auto", "off"] = "auto"  # auto: taken where it predicts what it has not seen
    max_degree: int = Field(default=10, ge=1, le=16)  # of its harmonics: 180 degrees over it
    min_gain: float = Field(
        default=0.03, ge=0, lt=1
    )  # share of the robust cost of unseen observations that it must take off
    rounds: int = Field(default=2, ge=1)  # of the field and the bundle adjustment after it


class PriorSettings(_Settings):
    """What the trajectory is worth in the graph."""

    rotation_deg: float = Field(default=0.5, gt=0)  # noise of a step's rotation
    translation: float = Field(default=0.1, gt=0)  # noise of a step's translation, part of the step
    absolute_rotation_deg: float = Field(default=30.0, gt=0)
    absolute_position: float = Field(default=0.3, gt=0)  # part of the trajectory's extent
    loss_sigmas: float = Field(default=2.0, gt=0)  # Cauchy scale: steps further off let go

    def faint(self) -> "PriorSettings":
        """The same of steps that have next to no say, but keep unseen ones in place."""
        looser = {"rotation_deg": 10 * self.rotation_deg, "translation": 10 * self.translation}
        return self.model_copy(update=looser)


class SolverSettings(_Settings):
    """Levenberg-Marquardt."""

    max_iterations: int = Field(default=50, ge=1)
    relative_tolerance: float = Field(default=1e-5, gt=0, lt=1)  # least decrease of the cost
    absolute_tolerance: float | None = Field(
        default=0.05, gt=0
    )  # the same, squared standard deviations; None = any
    loss: Literal["none", "huber", "cauchy", "geman_mcclure"] = "cauchy"
    loss_sigmas: float = Field(default=1.0, gt=0)  # scale of the loss, standard deviations
    lambda_initial: float = Field(default=1e-4, gt=0)  # damping, part of the diagonal
    num_threads: int | None = Field(default=None, ge=1)  # None = all cores

    def threads(self) -> int:
        """How many to use."""
        return self.num_threads or os.cpu_count() or 1


class PhotometricSettings(_Settings):
    """Direct alignment of patches, joint with the other families."""

    levels: tuple[int, ...] = Field(
        default=(0,), min_length=1
    )  # halvings of the panorama, in order
    max_width: int = Field(default=4096, ge=128)  # pixels of level 0; larger panoramas are halved
    size: int = Field(default=9, ge=3, le=33)  # pixels across a patch
    spacing_deg: float = Field(default=7.0, gt=0, le=60)  # between patches of a frame
    targets: int = Field(default=8, ge=1)  # frames that a patch is looked for in, nearest in space
    min_gradient: float = Field(default=2.0, gt=0)  # grey values per pixel, least of a patch
    min_correlation: float = Field(default=0.8, ge=-1, le=1)  # with the template, at the start
    depth_levels: int = Field(default=2, ge=0)  # coarser ones on which depths are found first
    depth_reach_deg: float = Field(default=6.0, gt=0, le=60)  # to map points that give the depth
    depth_tolerance: float = Field(default=0.03, gt=0)  # relative, of map points on one plane
    depth_sigma: float = Field(default=0.2, gt=0)  # relative, of a patch's depth
    slope_sigma: float = Field(default=0.7, gt=0)  # of its tilt, as a tangent
    noise_grey: float = Field(default=2.0, gt=0)  # grey values of a pixel
    noise_contrast: float = Field(default=0.1, ge=0)  # further noise, part of the contrast
    inflation: float = Field(default=2.0, gt=0)  # of sigmas: pixels of a patch err together
    loss_sigmas: float = Field(default=2.0, gt=0)  # Cauchy scale, of a patch's mean residual
    max_frame_ratio: float = Field(
        default=2.0, gt=1
    )  # residual of a frame over the median of all; above, it is weighted down
    max_frame_growth: float = Field(
        default=1.2, gt=1
    )  # of a frame's geometric residual under the joint solve; above, it is weighted down
    max_growth: float = Field(default=1.05, gt=0)  # of all geometric cost, or the solve is undone
    tolerance: float = Field(default=1e-3, gt=0, lt=1)  # of the joint solve
    polish_steps: int = Field(default=0, ge=0)  # of planes, after each step of the poses


class SplatFactorSettings(_Settings):
    """Poses refined against a splat of their own frames; see also `SplatSettings`."""

    sizes: tuple[Annotated[int, Field(ge=16, le=_MAX_FACE)], ...] = Field(
        default=(48, 96), min_length=1
    )  # pixels of a face, in order
    first_steps: int = Field(default=400, ge=1)  # of training, before poses move at each size
    steps: int = Field(
        default=150, ge=1
    )  # of training after each move: a splat that has yet to follow speaks against it
    moves: int = Field(default=3, ge=1)  # of the poses, at most, at each size
    solver_steps: int = Field(default=2, ge=1)  # of Levenberg-Marquardt in a move
    min_sigmas: float = Field(
        default=2.0, ge=0
    )  # of evidence for a move in standard errors, or it is undone
    max_growth: float = Field(default=1.05, gt=0)  # of all geometric cost, or a move is undone
    held_out_every: int = Field(default=8, ge=2)  # panoramas that judge: no splat sees them
    max_gaussians: int = Field(default=30_000, ge=1)
    sh_degree: int = Field(default=1, ge=0, le=3)
    backend: Literal["auto", "gsplat", "cpu"] = "auto"


# Which formats have a place for images that are no faces.
FORMATS_OF: dict[str, tuple[str, ...]] = {
    "fisheye": ("colmap", "colmap-flat", "nerfstudio"),
    "panorama": ("colmap-erp", "nerfstudio", "tum"),
}


class ExportSettings(_Settings):
    """Datasets written at the end of a run."""

    formats: tuple[
        Literal["colmap", "colmap-flat", "colmap-erp", "nerfstudio", "ply", "tum"], ...
    ] = ("colmap",)
    face_size: int | None = Field(
        default=None, ge=16, le=_MAX_FACE
    )  # pixels; None = a quarter of the panorama's width
    images: Literal["auto", "cube", "lenses", "fisheye", "panorama"] = "auto"  # six faces as seen
    # from one centre, ten of one lens each where two are known, raw fisheyes as they are, panoramas
    # at the map's depth; auto: cube, of raw fisheyes lenses
    fetched: bool = False  # datasets hold the frames, too, that were fetched where the map was weak

    @model_validator(mode="after")
    def _images_fit(self) -> "ExportSettings":
        fitting = FORMATS_OF.get(self.images, self.formats)
        for name in self.formats:
            if name not in fitting:
                choices = ", ".join(fitting)
                raise ValueError(f"images = {self.images} goes with {choices}, not with {name}")
        return self


class SplatSettings(_Settings):
    """Training of a Gaussian splat: the rates of Kerbl et al., 2023, times scaled to the length."""

    iterations: int = Field(default=7000, ge=1, le=10**7)  # views shown, one at a time
    face_size: int = Field(default=256, ge=16, le=_MAX_FACE)  # pixels
    backend: Literal["auto", "gsplat", "cpu"] = "auto"
    held_out_every: int = Field(default=8, ge=2)  # whole panoramas kept for evaluation
    sh_degree: int = Field(default=3, ge=0, le=3)
    max_gaussians: int | None = Field(default=None, ge=1)  # None = as pixels and memory allow
    ssim_weight: float = Field(default=0.2, ge=0, le=1)
    near: float = Field(default=0.01, gt=0)  # Gaussians nearer are not seen, part of the extent
    rate_means: float = Field(default=1.6e-4, gt=0)  # at the start, part of the extent
    rate_means_end: float = Field(default=1.6e-6, gt=0)
    rate_scales: float = Field(default=5e-3, gt=0)
    rate_rotations: float = Field(default=1e-3, gt=0)
    rate_opacities: float = Field(default=0.05, gt=0)
    rate_colors: float = Field(default=2.5e-3, gt=0)  # a twentieth of it for what varies by view
    rate_fade: float = Field(default=1.0, gt=0, le=1)  # of all but the means' rate, at the end
    densify: bool = True
    densify_pull: float = Field(default=2e-4, gt=0)  # gradient of a centre, focal lengths
    densify_scale: float = Field(default=0.01, gt=0)  # smaller: cloned, larger: split; of extent
    min_opacity: float = Field(default=5e-3, gt=0, lt=1)
    max_scale: float = Field(default=0.1, gt=0)  # of extent
    checkpoint_every_s: float = Field(default=60.0, gt=0)
    seed: int = Field(default=0, ge=0, le=_MAX_SEED)


class GpsSettings(_Settings):
    """GPS positions of frames, and how well receivers know them."""

    file: _Text | None = None  # CSV, GPX, a video, or "exif" of the frames: for the gps factors
    sigma_m: float = Field(
        default=3.0, gt=0
    )  # metres across, standard deviation per axis: no fix is better; times its DOP where given
    sigma_up_m: float = Field(default=5.0, gt=0)  # metres up, the same
    correlation_s: float = Field(default=60.0, gt=0)  # time constant after which errors differ
    loss_sigmas: float = Field(default=2.0, gt=0)  # Cauchy scale of the gps factors


class PlacementSettings(_Settings):
    """Where the exported world is: upright, to scale, on the earth; the run itself stays put."""

    up: Literal["auto", "none"] = "none"  # auto: gravity from rigs and vertical edges
    length: Annotated[float, Field(gt=0)] | Literal["lens"] | None = None  # metres between the two
    # of `between`, or by the distance between the lenses
    between: tuple[str, str] | None = None  # frames by name, or points "x,y,z" of the run's world
    gps: _Text | None = None  # CSV, GPX, a video, or "exif": metres, east-north-up
    align: _Text | None = None  # TUM file of true poses: its world and unit
    scan: _Text | None = None  # PLY, PCD, LAS, LAZ, OBJ or GLB of the place: its world and unit
    pairs: _Text | None = None  # file of three or more pairs, run and scan, to find it by


BuiltIn = Literal["bearing", "reprojection", "gps", "photometric", "splat"]  # families of gsba


def installed_families() -> dict[str, EntryPoint]:
    """Entry points of families that packages provide, by name: see `gsba.Family`."""
    return {point.name: point for point in entry_points(group="gsba.families")}


class RefineSettings(_Settings):
    """Everything a run depends on."""

    video: VideoSettings = VideoSettings()
    odometry: OdometrySettings = OdometrySettings()
    read: ReadSettings = ReadSettings()
    cubemap: CubemapSettings = CubemapSettings()
    features: FeatureSettings = FeatureSettings()
    weak_frames: WeakFrameSettings = WeakFrameSettings()
    matching: MatchingSettings = MatchingSettings()
    pairs: PairSettings = PairSettings()
    verify: VerifySettings = VerifySettings()
    triangulate: TriangulateSettings = TriangulateSettings()
    priors: PriorSettings = PriorSettings()
    rounds: RoundSettings = RoundSettings()
    patches: PatchSettings = PatchSettings()
    camera: CameraSettings = CameraSettings()
    stitching: StitchingSettings = StitchingSettings()
    solver: SolverSettings = SolverSettings()
    factors: tuple[BuiltIn | str, ...] = Field(default=("bearing",), min_length=1)  # a package's
    # families by the name of their entry point, with what they are to read: NAME or NAME:ARGUMENT
    gps: GpsSettings = GpsSettings()
    photometric: PhotometricSettings = PhotometricSettings()
    splat: SplatFactorSettings = SplatFactorSettings()
    export: ExportSettings = ExportSettings()
    placement: PlacementSettings = PlacementSettings()
    seed: int = Field(default=0, ge=0, le=_MAX_SEED)

    def direct_families(self) -> tuple[str, ...]:
        """Those that compare pixels of whole frames."""
        return tuple(name for name in self.factors if name in ("photometric", "splat"))

    def package_families(self) -> tuple[str, ...]:
        """Those that packages provide."""
        return tuple(name for name in self.factors if name not in get_args(BuiltIn))

    def untimed(self) -> "RefineSettings":
        """Without what is said in seconds, for frames whose times are no more than an order."""
        camera = self.camera.model_copy(update={"name": None, "readout_ms": None})
        return self.model_copy(update={"camera": camera})

    def with_gates(self, scale: float) -> "RefineSettings":
        """The same with gates of matching a number of times as wide, for lenses that are not known
        as well as these gates ask for."""
        verify = {"max_error_deg": scale * self.verify.max_error_deg}
        refined = {"rotation_deg": scale * self.pairs.refined.rotation_deg}
        pairs = {
            "point_deg": scale * self.pairs.point_deg,
            "refined": self.pairs.refined.model_copy(update=refined),
        }
        sections = {
            "verify": self.verify.model_copy(update=verify),
            "pairs": self.pairs.model_copy(update=pairs),
        }
        return self.model_copy(update=sections)

    def with_faint_priors(self) -> "RefineSettings":
        """For a trajectory that is no more than a start."""
        return self.model_copy(update={"priors": self.priors.faint()})

    def plainer(self) -> "RefineSettings":
        """For a first solution: features alone, without patches, pixels or splats."""
        unaligned = self.patches.model_copy(update={"rounds": 0})
        families = tuple(name for name in self.factors if name not in self.direct_families())
        return self.model_copy(update={"patches": unaligned, "factors": families})

    @model_validator(mode="after")
    def _geometry_first(self) -> "RefineSettings":
        for name in self.factors:
            known = (*get_args(BuiltIn), *installed_families())
            if name.partition(":")[0] not in known:
                listed = ", ".join(f'"{one}"' for one in known)
                raise ValueError(f'factors: "{name}" is none of those installed: {listed}')
        if not {"bearing", "reprojection"} & set(self.factors):
            named = " and ".join(self.factors)
            raise ValueError(f"factors: {named} starts from bearing or reprojection; add one")
        return self

    @model_validator(mode="after")
    def _gps_has_fixes(self) -> "RefineSettings":
        if ("gps" in self.factors) != (self.gps.file is not None):
            raise ValueError(
                "factors: gps needs positions: pass --gps FILE, or gps.file"
                if self.gps.file is None
                else "gps.file is read by the gps factors: add gps to factors"
            )
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
