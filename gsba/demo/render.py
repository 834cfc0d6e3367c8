"""Equirectangular pictures of a scene, anti-aliased."""

import numpy as np

from gsba.demo.raycast import Scene, coordinates, face_distance, in_bands, kernel, nearest, part
from gsba.demo.sampling import albedo_at, light_at

# Offsets from the pixel's centre, in pixels, of the rays where faces meet: a rotated grid, which
# tells four levels of coverage apart along either axis.
EDGE_SAMPLES = ((-0.375, 0.125), (-0.125, -0.375), (0.125, 0.375), (0.375, -0.125))
EXPOSURE = 1.1  # of the tone curve 1 - exp(-EXPOSURE * radiance)


def render_erp(scene: Scene, world_T_rig: np.ndarray, width: int, height: int) -> np.ndarray:
    """Equirectangular picture of the scene, filtered over each pixel.

    Inside a face the texture filter covers the pixel; where faces meet, four rays with a quarter
    of the filter each do.

    Args:
        world_T_rig: (4, 4) float64, rotation and position of the panorama.
        width, height: pixels, width = 2 height.

    Returns:
        (height, width, 3) float32, RGB, 0..255, black where nothing is hit.
    """
    world_R_rig = np.ascontiguousarray(world_T_rig[:3, :3], dtype=np.float64)
    rig_in_world = np.ascontiguousarray(world_T_rig[:3, 3], dtype=np.float64)
    faces = np.empty((height, width), dtype=np.int64)
    image = np.empty((height, width, 3), dtype=np.float32)
    in_bands(_find_faces, height, scene, world_R_rig, rig_in_world, faces)
    in_bands(_shade, height, scene, world_R_rig, rig_in_world, faces, image)
    return image


@kernel
def _find_faces(start, stop, scene, R, o, faces):
    """Face at each pixel's centre, -1 for none, into rows of faces (H, W)."""
    height, width = faces.shape
    step = np.pi / height
    o = (o[0], o[1], o[2])
    for row in range(start, stop):
        for column in range(width):
            x, y, z = _direction((column + 0.5) * step - np.pi, np.pi / 2 - (row + 0.5) * step)
            faces[row, column] = nearest(scene, o, _rotate(R, x, y, z), np.inf)[1]


@kernel
def _shade(start, stop, scene, R, o, faces, image):
    """Colours of rows of image (H, W, 3)."""
    height, width = faces.shape
    step = np.pi / height
    o = (o[0], o[1], o[2])
    for row in range(start, stop):
        for column in range(width):
            longitude, latitude = (column + 0.5) * step - np.pi, np.pi / 2 - (row + 0.5) * step
            if _uniform(faces, row, column):
                color = _color(scene, R, o, longitude, latitude, step, faces[row, column])
                red, green, blue = color
            else:
                red, green, blue = 0.0, 0.0, 0.0
                for k in range(4):
                    x, y = step * EDGE_SAMPLES[k][0], step * EDGE_SAMPLES[k][1]
                    color = _color(scene, R, o, longitude + x, latitude + y, step / 2, -1)
                    red, green, blue = red + color[0], green + color[1], blue + color[2]
                red, green, blue = red / 4, green / 4, blue / 4
            image[row, column, 0] = red
            image[row, column, 1] = green
            image[row, column, 2] = blue


@part
def _uniform(faces, row, column):
    """Whether a pixel and its eight neighbours (wrapping around the seam) see one face."""
    height, width = faces.shape
    for j in range(max(row - 1, 0), min(row + 2, height)):
        for i in range(column - 1, column + 2):
            if faces[j, i % width] != faces[row, column]:
                return False
    return True


@part
def _rotate(R, x, y, z):
    return (
        R[0, 0] * x + R[0, 1] * y + R[0, 2] * z,
        R[1, 0] * x + R[1, 1] * y + R[1, 2] * z,
        R[2, 0] * x + R[2, 1] * y + R[2, 2] * z,
    )


@part
def _direction(longitude, latitude):
    c = np.cos(latitude)
    return c * np.sin(longitude), -np.sin(latitude), c * np.cos(longitude)


@part
def _color(scene, R, o, longitude, latitude, step, known):
    """Colour (3), 0..255, of the square of angle `step` at this ray, on face `known` if >= 0."""
    cy, sy = np.cos(longitude), np.sin(longitude)
    cp, sp = np.cos(latitude), np.sin(latitude)
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
