"""A plain dense rasteriser in float64: every Gaussian at every pixel, no tiles, no bounds."""

import numpy as np

from gsba.splat.camera import FaceCamera
from gsba.splat.gaussians import Gaussians


def render(gaussians: Gaussians, camera: FaceCamera, degree: int) -> np.ndarray:
    """(H, W, 5) red, green, blue, expected depth, alpha; arrays of any float type."""
    means, log_scales, quaternions, logits, sh = (
        np.asarray(array, np.float64) for array in gaussians.arrays()
    )
    local = (means - camera.face_in_world) @ camera.world_R_face
    offsets = means - camera.face_in_world
    directions = offsets / np.linalg.norm(offsets, axis=1, keepdims=True)
    num = (degree + 1) ** 2
    values = np.einsum("nk,nkc->nc", harmonics(directions)[:, :num], sh[:, :num])
    colors = np.maximum(values + 0.5, 0)
    opacities = 1 / (1 + np.exp(-logits))
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    size = np.array([camera.width, camera.height])
    image, through = np.zeros((*u.shape, 5)), np.ones(u.shape)
    for g in np.argsort(local[:, 2]):
        x, y, z = local[g]
        if z <= 1e-2:
            continue
        middle, limit = 0.5 * size - camera.principal, 1.3 * 0.5 * size
        bounds = (middle - limit) / camera.focal, (middle + limit) / camera.focal
        slopes = np.clip([x / z, y / z], *bounds)
        affine = camera.focal / z * np.array([[1, 0, -slopes[0]], [0, 1, -slopes[1]]])
        axes = rotation(quaternions[g]) * np.exp(log_scales[g])
        root = affine @ camera.world_R_face.T @ axes
        inverse = np.linalg.inv(root @ root.T + 0.3 * np.eye(2))
        du = u - (camera.focal * x / z + camera.principal[0])
        dv = v - (camera.focal * y / z + camera.principal[1])
        power = inverse[0, 0] * du**2 + 2 * inverse[0, 1] * du * dv + inverse[1, 1] * dv**2
        alpha = np.minimum(opacities[g] * np.exp(-0.5 * power), 0.99)
        alpha = np.where((alpha >= 1 / 255) & (through >= 1e-4), alpha, 0)
        image += (alpha * through)[..., None] * np.array([*colors[g], z, 1])
        through = through * (1 - alpha)
    image[..., 3] /= np.maximum(image[..., 4], 1e-12)
    return image


def rotation(wxyz: np.ndarray) -> np.ndarray:
    """By the sandwich product, unlike the code under test."""
    w, v = wxyz[0] / np.linalg.norm(wxyz), wxyz[1:] / np.linalg.norm(wxyz)
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def harmonics(directions: np.ndarray) -> np.ndarray:
    """(N, 16) real spherical harmonics from scipy's complex ones, without Condon-Shortley."""
    from scipy.special import sph_harm_y

    x, y, z = directions.T
    polar, azimuth = np.arccos(np.clip(z, -1, 1)), np.arctan2(y, x)
    columns = []
    for degree in range(4):
        for order in range(-degree, degree + 1):
            value = sph_harm_y(degree, abs(order), polar, azimuth)
            part = value.imag if order < 0 else value.real
            columns.append(part * (np.sqrt(2) if order else 1))
    return np.stack(columns, axis=1)
