"""Lens calibrations by Insta360, which its cameras write into their files, as starting lenses.

A calibration is numbers with underscores between them: how many lenses, the numbers of each, then
those of both. Four generations are known, which differ in the number of numbers:

1   radius, centre x y, angles; for both: width, height, kind
2   radius, centre x y, angles, position x y z, coefficients c0 c1 c2 c3, width, height, kind
3   xi, focal length x y, centre x y, angles, position, k1 k2 k3 p1 p2, width, height, kind
6   as 3, with k1 to k5, p1 to p4, s1 to s4

Widths and heights are of a canvas with both lenses side by side, as the whole sensors see them;
recordings show a window of it (see `SensorWindow` of `gsba.containers.insta360`).

Generations 3 and 6: with u = sin(a) / (cos(a) + xi) at an angle a from the axis, pixels lie
f u (1 + k1 u^2 + k2 u^4 + ...) from the centre (C. Mei and P. Rives, ICRA 2007). Terms p and s are
left out: they move pixels by a thousandth of the radius. Generation 2: c0 a + c1 a^2 + ... with a
in radians, scaled such that `radius` is at 100 degrees. Generation 1: proportional to a, `radius`
at 100 degrees. Those 100 degrees, and that c0 to c3 are of radians, were found out from published
calibrations of one X4: its third generation reaches the radius of the first at 100.6 and
that of the second at 100.2 degrees, and its second generation agrees with the third within 1 %.

Angles are degrees: the third, about the axis, is near 0, 90 or 180, and those of both lenses add up
to 180. A camera's upright axes are turned into a lens's by Rz(third - 90) Ry(first) Rx(second),
after a half turn about y for the back lens (as pictures of an X4 Air and a ONE X2 showed, in the
format study of the Kjerag project). The first two are below a degree, so that their order does not
matter. Publicly known: OpenSpeleo/insta360-rs, docs/INSV_FORMAT.md and calibration.md.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from gsba.camera.fisheye import Pair
from gsba.log import GsbaError, brief
from gsba.types import Fisheye

_GENERATIONS = {6: 1, 16: 2, 19: 3, 27: 6}  # numbers of one lens -> generation
_COUNTS = {16: 6, 34: 16, 40: 19, 56: 27}  # numbers of a calibration -> numbers of one lens
_REFERENCE_ANGLE_RAD = np.deg2rad(100.0)  # angle to which `radius` belongs
_DIRECTION_SIGMA_RAD = {n: np.deg2rad(deg) for n, deg in ((1, 1.5), (2, 0.7), (3, 0.4), (6, 0.4))}
ROTATION_SIGMA_RAD = np.deg2rad(1.5)  # of one lens against the other about each axis, standard
# deviation; an X4 Air's own calibration was off by 2.4 degrees (Kjerag's study)
_HALF_TURN_ABOUT_Y = np.diag([-1.0, 1.0, -1.0])  # rotation by pi about y


@dataclass(frozen=True, slots=True)
class FactoryLens:
    """One lens, in pixels of its half of the canvas."""

    focal: float  # pixels per radian in the middle
    radial: tuple[float, float, float, float]  # k1 to k4 of `Fisheye`
    centre: tuple[float, float]  # pixels, corner origin
    camera_R_lens: np.ndarray  # (3, 3), to the camera's upright axes: x right, y down, z ahead


@dataclass(frozen=True, slots=True)
class FactoryCalibration:
    """A calibration as a camera wrote it, and the recorded part of its sensors."""

    text: str  # numbers with underscores between them
    camera: str = ""  # model; "" = not known
    sensor: tuple[int, int] | None = None  # width and height, pixels, of one lens's sensor; None
    # = those in the text
    window: tuple[int, int] | None = None  # width and height of its recorded part; None = not known
    shift: tuple[int, int] = (0, 0)  # from the sensor's middle to that part's, pixels right, down
    back_first: bool = False  # True if pictures of the text's second lens come first


@dataclass(frozen=True, slots=True)
class FactoryLenses:
    """Both lenses of a camera as its maker calibrated them."""

    generation: int  # 1, 2, 3 or 6
    lenses: tuple[FactoryLens, FactoryLens]  # front, back
    canvas: tuple[int, int]  # width and height of one lens's half, pixels
    window: tuple[float, float, float, float] | None  # recorded part of that half: left, top,
    # width, height; None = not known
    angles_known: bool  # True if angles have the form described above; else they are unused

    @property
    def direction_sigma(self) -> float:
        """Standard deviation of directions of pixels in the axes of their own lens, rad."""
        return float(_DIRECTION_SIGMA_RAD[self.generation])

    def pairs(self, size: tuple[int, int]) -> list[Pair]:
        """Lenses for pictures of a size (width, height) that show the window or, less likely, all
        of the sensor; pictures of another aspect ratio show the middle of it."""
        whole = (0.0, 0.0, float(self.canvas[0]), float(self.canvas[1]))
        windows = dict.fromkeys([whole if self.window is None else self.window, whole])
        return [self._pair(size, *window) for window in windows]

    def _pair(
        self, size: tuple[int, int], left: float, top: float, width: float, height: float
    ) -> Pair:
        scale = max(size[0] / width, size[1] / height)
        middle = np.array([left + width / 2, top + height / 2])
        front, back = (
            Fisheye(
                *size,
                focal=lens.focal * scale,
                principal=_two(np.array(size) / 2 + scale * (np.array(lens.centre) - middle)),
                radial=lens.radial,
                rotation=tuple(Rotation.from_matrix(lens.camera_R_lens).as_rotvec().tolist()),
            )
            for lens in self.lenses
        )
        return front, back


def parse_factory_lenses(calibration: FactoryCalibration) -> FactoryLenses:
    """Lenses that a calibration of Insta360 describes. GsbaError: the form is unknown, or no lenses
    have such numbers."""
    try:
        return _of_numbers(np.array(calibration.text.split("_"), np.float64), calibration)
    except ValueError as error:
        text = brief(calibration.text)
        raise GsbaError(f"lens calibration '{text}' of {calibration.camera}: {error}") from None


def _of_numbers(numbers: np.ndarray, calibration: FactoryCalibration) -> FactoryLenses:
    """Lenses from all numbers of a calibration."""
    count = _COUNTS.get(len(numbers))
    if count is None or numbers[0] != 2 or not (abs(numbers) < 1e7).all():
        raise ValueError("its form is not known")
    generation, parts = _GENERATIONS[count], numbers[1 : 1 + 2 * count].reshape(2, count)
    canvas = numbers[-3:-1] if generation == 1 else parts[0, -3:-1]
    half = canvas / (2, 1)
    if not (half >= 16).all() or (half > 1 << 15).any():
        raise ValueError(f"its canvas cannot be {canvas[0]:g}x{canvas[1]:g}")
    at = 3 if generation >= 3 else 1  # index of the centre
    angles = parts[:, at + 2 : at + 5]
    # degrees, the third ones about the axes and back to back
    tilts, about = abs(angles[:, :2]), angles[:, 2].sum() % 360
    known = bool((tilts < 5.0).all() and abs(about - 180) < 10.0)
    lenses = []
    for n in range(2):
        centre = parts[n, at : at + 2] - (n * half[0], 0)
        if (abs(centre - half / 2) > half / 4).any():
            raise ValueError(f"the centre of lens {n + 1} is far from the middle")
        yaw, pitch, roll = angles[n] if known else np.array([0, 0, 90.0])
        turn = Rotation.from_euler("ZYX", [roll - 90, yaw, pitch], degrees=True).as_matrix()
        rotation = (turn @ (_HALF_TURN_ABOUT_Y if n == 1 else np.eye(3))).T
        lenses.append(FactoryLens(*_radial_model(generation, parts[n]), _two(centre), rotation))
    if calibration.back_first:
        lenses = [
            replace(each, camera_R_lens=_HALF_TURN_ABOUT_Y @ each.camera_R_lens)
            for each in lenses[::-1]
        ]
    return FactoryLenses(
        generation=generation,
        lenses=(lenses[0], lenses[1]),
        canvas=(int(half[0]), int(half[1])),
        window=_window(half, calibration),
        angles_known=known,
    )


def _radial_model(
    generation: int, numbers: np.ndarray
) -> tuple[float, tuple[float, float, float, float]]:
    """Focal length, pixels per radian, and k1 to k4 of `Fisheye`, fitted over all angles."""
    angles = np.linspace(0, np.deg2rad(100.0), 201)[1:]
    if generation == 1:
        radii = numbers[0] * angles / _REFERENCE_ANGLE_RAD
    elif generation == 2:
        shape = np.polynomial.Polynomial([0.0, *numbers[9:13]])
        radii = numbers[0] * shape(angles) / (shape(_REFERENCE_ANGLE_RAD) or np.inf)
    else:
        count = 3 if generation == 3 else 5
        shape = np.polynomial.Polynomial([1.0, *numbers[11 : 11 + count]])
        within = np.cos(angles) + numbers[0]
        if within.min() <= 0.01:
            raise ValueError(f"no lens has xi {numbers[0]:g}")
        u = np.sin(angles) / within
        radii = numbers[1:3].mean() * u * shape(u * u)
    if not np.isfinite(radii).all() or (np.diff(radii, prepend=0.0) <= 0).any():
        raise ValueError("its picture folds over")
    powers = angles[:, None] ** np.array([1, 3, 5, 7, 9])
    found = np.linalg.lstsq(powers, radii, rcond=None)[0]
    if found[0] <= 0:
        raise ValueError("it has no focal length")
    k1, k2, k3, k4 = (float(k) for k in found[1:] / found[0])
    return float(found[0]), (k1, k2, k3, k4)


def _window(
    half: np.ndarray, calibration: FactoryCalibration
) -> tuple[float, float, float, float] | None:
    """Left, top, width and height in a lens's half (2,) of the canvas; None = beyond it."""
    if calibration.window is None:
        return None
    scale = half / (half if calibration.sensor is None else np.array(calibration.sensor))
    extent = scale * calibration.window
    corner = (half - extent) / 2 + scale * calibration.shift
    if (corner < -0.5).any() or (corner + extent > half + 0.5).any() or (extent < 1).any():
        return None
    return (*_two(corner), *_two(extent))


def _two(values: np.ndarray) -> tuple[float, float]:
    x, y = (float(value) for value in values)
    return x, y
