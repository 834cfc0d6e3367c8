"""Anti-aliased equirectangular images of a scene, from one point or through a moving lens."""

from typing import NamedTuple

import numpy as np

from gsba.demo.raycast import Scene, coordinates, face_distance, in_bands, kernel, nearest, part
from gsba.demo.sampling import albedo_at, light_at

# Offsets of rays from the centre of a pixel at which faces meet, in pixels: a rotated grid, which
# distinguishes four levels of coverage along either axis.
EDGE_SAMPLES = ((-0.375, 0.125), (-0.125, -0.375), (0.125, 0.375), (0.375, -0.125))
EXPOSURE = 1.1  # of the tone curve 1 - exp(-EXPOSURE * radiance)


class Eye(NamedTuple):
    """Rolling-shutter lens: rays in directions of the rig, each at the time of its row."""

    world_T_eyes: np.ndarray  # (K, 3, 4) float64, rotations of the rig and positions of the eye,
    # evenly spaced from the first row's time to the last one's; one = a global shutter
    facing: float = 1.0  # lens: 1 looks along the rig's z, -1 in the opposite direction
    sweep: tuple[float, float] = (-1.0, 0.0)  # row direction: rig's x and y, unit
    half_fov: float = np.pi  # rad, from the axis to the first and to the last row
    bend: tuple[float, float] = (0.0, 0.0)  # distortion: a point at angle a from the axis is
    # a + bend[0] a^3 + bend[1] a^5 from the image's middle, up to scale
    least: float = -2.0  # smallest facing * z of rendered unit directions; -2 = all


def render_erp(scene: Scene, world_T_rig: np.ndarray, width: int, height: int) -> np.ndarray:
    """Equirectangular image of the scene from one point, filtered over each pixel.

    Args:
        world_T_rig: (4, 4) float64, pose of the panorama.
        width, height: pixels, width = 2 height.

    Returns:
        (height, width, 3) float32, RGB, 0..255, black for rays that hit nothing.
    """
    return render_eye(scene, Eye(world_T_rig[None, :3]), width, height)


def render_eye(scene: Scene, eye: Eye, width: int, height: int) -> np.ndarray:
    """Equirectangular image of an eye's part of the sphere, filtered over each pixel.

    Inside a face the texture filter covers the pixel; where faces meet, four rays with a quarter
    of the filter each cover it.

    Args:
        width, height: pixels, width = 2 height.

    Returns:
        (height, width, 3) float32, RGB, 0..255, black outside of the lens's part and for rays that
        hit nothing.
    """
    eye = eye._replace(world_T_eyes=np.ascontiguousarray(eye.world_T_eyes, dtype=np.float64))
    faces = np.full((height, width), -1, dtype=np.int64)
    image = np.zeros((height, width, 3), dtype=np.float32)
    longitudes = (np.arange(width) + 0.5) * (np.pi / height) - np.pi
    columns = np.column_stack([np.sin(longitudes), np.cos(longitudes)])
    in_bands(_find_faces, height, scene, eye, columns, faces)
    in_bands(_shade, height, scene, eye, columns, faces, image)
    return image


@kernel
def _find_faces(start, stop, scene, eye, columns, faces):
    """Write the face at each pixel's centre, -1 = none, into rows of faces (H, W).

    columns: (W, 2) sine and cosine of their longitudes.
    """
    height, width = faces.shape
    step = np.pi / height
    least = eye.least - 3 * step  # pixels beyond a lens's image for which faces are found, too
    for row in range(start, stop):
        latitude = np.pi / 2 - (row + 0.5) * step
        cp, sp = np.cos(latitude), np.sin(latitude)
        before = -1
        for column in range(width):
            x, y, z = cp * columns[column, 0], -sp, cp * columns[column, 1]
            if eye.facing * z >= least:
                R, o = _pose(eye, x, y, z)
                d, limit = _rotate(R, x, y, z), np.inf
                if before >= 0:  # mostly seen again: what lies behind it is left out
                    limit = face_distance(scene, before, o, d, np.inf)
                nearer = nearest(scene, o, d, limit)[1]
                if nearer >= 0 or limit == np.inf:
                    before = nearer
                faces[row, column] = before


@kernel
def _shade(start, stop, scene, eye, columns, faces, image):
    """Write colours into rows of image (H, W, 3); columns as for `_find_faces`."""
    height, width = faces.shape
    step = np.pi / height
    for row in range(start, stop):
        latitude = np.pi / 2 - (row + 0.5) * step
        cp, sp = np.cos(latitude), np.sin(latitude)
        for column in range(width):
            sy, cy = columns[column, 0], columns[column, 1]
            if eye.facing * cp * cy < eye.least:
                continue
            if _uniform(faces, row, column):
                color = _color(scene, eye, cp, sp, cy, sy, step, faces[row, column])
                red, green, blue = color
            else:
                red, green, blue = 0.0, 0.0, 0.0
                for k in range(4):
                    x = (column + 0.5 + EDGE_SAMPLES[k][0]) * step - np.pi
                    y = latitude + step * EDGE_SAMPLES[k][1]
                    cosines = np.cos(y), np.sin(y), np.cos(x), np.sin(x)
                    color = _color(scene, eye, *cosines, step / 2, -1)
                    red, green, blue = red + color[0], green + color[1], blue + color[2]
                red, green, blue = red / 4, green / 4, blue / 4
            image[row, column, 0] = red
            image[row, column, 1] = green
            image[row, column, 2] = blue


@part
def _pose(eye, x, y, z):
    """Rotation (9 numbers, row by row) and position (3) of the eye when it reads (x, y, z)."""
    T, last = eye.world_T_eyes, len(eye.world_T_eyes) - 1
    k, f = 0, 0.0
    if last > 0:
        across = np.sqrt(x * x + y * y)
        angle = np.arctan2(across, eye.facing * z)
        radius = _radius(eye, angle) / _radius(eye, eye.half_fov)
        along = (x * eye.sweep[0] + y * eye.sweep[1]) / max(across, 1e-12)
        at = min(max((0.5 + 0.5 * radius * along) * last, 0.0), float(last))
        k = min(int(at), last - 1)
        f = at - k
    n = min(k + 1, last)
    return (
        T[k, 0, 0] + f * (T[n, 0, 0] - T[k, 0, 0]),
        T[k, 0, 1] + f * (T[n, 0, 1] - T[k, 0, 1]),
        T[k, 0, 2] + f * (T[n, 0, 2] - T[k, 0, 2]),
        T[k, 1, 0] + f * (T[n, 1, 0] - T[k, 1, 0]),
        T[k, 1, 1] + f * (T[n, 1, 1] - T[k, 1, 1]),
        T[k, 1, 2] + f * (T[n, 1, 2] - T[k, 1, 2]),
        T[k, 2, 0] + f * (T[n, 2, 0] - T[k, 2, 0]),
        T[k, 2, 1] + f * (T[n, 2, 1] - T[k, 2, 1]),
        T[k, 2, 2] + f * (T[n, 2, 2] - T[k, 2, 2]),
    ), (
        T[k, 0, 3] + f * (T[n, 0, 3] - T[k, 0, 3]),
        T[k, 1, 3] + f * (T[n, 1, 3] - T[k, 1, 3]),
        T[k, 2, 3] + f * (T[n, 2, 3] - T[k, 2, 3]),
    )


@part
def _radius(eye, angle):
    """Distance from the image's middle of a ray at an angle from the axis, up to scale."""
    square = angle * angle
    return angle * (1 + square * (eye.bend[0] + square * eye.bend[1]))


@part
def _uniform(faces, row, column):
    """True if a pixel and its eight neighbours, wrapped at the seam, see one face."""
    height, width = faces.shape
    for j in range(max(row - 1, 0), min(row + 2, height)):
        for i in range(column - 1, column + 2):
            if faces[j, i % width] != faces[row, column]:
                return False
    return True


@part
def _rotate(R, x, y, z):
    return (
        R[0] * x + R[1] * y + R[2] * z,
        R[3] * x + R[4] * y + R[5] * z,
        R[6] * x + R[7] * y + R[8] * z,
    )


@part
def _color(scene, eye, cp, sp, cy, sy, step, known):
    """Colour (3), 0..255, of the square of angle `step` at this ray, on face `known` if >= 0.

    cp, sp, cy, sy: cosine and sine of the ray's latitude and longitude.
    """
    R, o = _pose(eye, cp * sy, -sp, cp * cy)
    d = _rotate(R, cp * sy, -sp, cp * cy)
    if known >= 0:
        t, q = face_distance(scene, known, o, d, np.inf), known
    else:
        t, q = nearest(scene, o, d, np.inf)
    if q < 0:
        return 0.0, 0.0, 0.0
    a, b = coordinates(scene, q, o, d, t)
    du = _rotate(R, step * cp * cy, 0.0, -step * cp * sy)
    dv = _rotate(R, step * sp * sy, step * cp, step * sp * cy)
    albedo = albedo_at(scene, q, a, b, d, t, du, dv)
    light = light_at(scene, scene.light, q, a, b)
    glow, gain = scene.emissions[q], -EXPOSURE / 255
    return (
        255 - 255 * np.exp(gain * (albedo[0] * light[0] + 255 * glow)),
        255 - 255 * np.exp(gain * (albedo[1] * light[1] + 255 * glow)),
        255 - 255 * np.exp(gain * (albedo[2] * light[2] + 255 * glow)),
    )
