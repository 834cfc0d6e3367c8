"""Compiled passes over Gaussians: to splats of one pinhole camera, and gradients back.

Projection by a local affine map (EWA: Zwicker et al., 2001) with the dilation and the guard band
of Kerbl et al., 3D Gaussian Splatting, 2023; colours by real spherical harmonics.
"""

import numpy as np

from factors.compiled import kernel_and_part

DILATION = 0.3  # pixels^2 added to both variances: no splat is thinner than a pixel
_INVERSE_MIN_ALPHA = 255.0  # 1 / the smallest alpha that is blended, see _tiles.MIN_ALPHA

_C0 = 0.28209479177387814
_C1 = 0.4886025119029199
_C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
_C3 = (
    0.5900435899266435,
    2.890611442640554,
    0.4570457994644658,
    0.3731763325901154,
    1.445305721320277,
)

_kernel, _part = kernel_and_part(fastmath={"contract"})


@_part
def _harmonics(x, y, z, num, basis, slopes):
    """First `num` real spherical harmonics at a unit vector, signs as in 3DGS.

    Args:
        basis: (16,) filled up to num.
        slopes: (16, 3) filled: derivatives as polynomials of x, y and z.
    """
    basis[0] = _C0
    if num > 1:
        basis[1], basis[2], basis[3] = -_C1 * y, _C1 * z, -_C1 * x
        slopes[1, 1], slopes[2, 2], slopes[3, 0] = -_C1, _C1, -_C1
    if num > 4:
        p, q, r = _C2
        basis[4], basis[5], basis[7] = p * x * y, -p * y * z, -p * x * z
        basis[6], basis[8] = q * (2 * z * z - x * x - y * y), r * (x * x - y * y)
        slopes[4, 0], slopes[4, 1] = p * y, p * x
        slopes[5, 1], slopes[5, 2] = -p * z, -p * y
        slopes[6, 0], slopes[6, 1], slopes[6, 2] = -2 * q * x, -2 * q * y, 4 * q * z
        slopes[7, 0], slopes[7, 2] = -p * z, -p * x
        slopes[8, 0], slopes[8, 1] = 2 * r * x, -2 * r * y
    if num > 9:
        xx, yy, zz = x * x, y * y, z * z
        p, q, r, s, t = _C3
        basis[9], basis[15] = -p * y * (3 * xx - yy), -p * x * (xx - 3 * yy)
        basis[10], basis[14] = q * x * y * z, t * z * (xx - yy)
        basis[11], basis[13] = -r * y * (4 * zz - xx - yy), -r * x * (4 * zz - xx - yy)
        basis[12] = s * z * (2 * zz - 3 * xx - 3 * yy)
        slopes[9, 0], slopes[9, 1] = -6 * p * x * y, -3 * p * (xx - yy)
        slopes[10, 0], slopes[10, 1], slopes[10, 2] = q * y * z, q * x * z, q * x * y
        slopes[11, 0], slopes[11, 1] = 2 * r * x * y, -r * (4 * zz - xx - 3 * yy)
        slopes[11, 2] = -8 * r * y * z
        slopes[12, 0], slopes[12, 1] = -6 * s * x * z, -6 * s * y * z
        slopes[12, 2] = s * (6 * zz - 3 * xx - 3 * yy)
        slopes[13, 0], slopes[13, 1] = -r * (4 * zz - 3 * xx - yy), 2 * r * x * y
        slopes[13, 2] = -8 * r * x * z
        slopes[14, 0], slopes[14, 1], slopes[14, 2] = 2 * t * x * z, -2 * t * y * z, t * (xx - yy)
        slopes[15, 0], slopes[15, 1] = -3 * p * (xx - yy), 6 * p * x * y


@_part
def _rotation(q, out):
    """Rotation matrix (3, 3) of a quaternion wxyz of any length; returns that length."""
    length = np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    w, x, y, z = q[0] / length, q[1] / length, q[2] / length, q[3] / length
    out[0, 0], out[0, 1], out[0, 2] = (
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
    )
    out[1, 0], out[1, 1], out[1, 2] = (
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
    )
    out[2, 0], out[2, 1], out[2, 2] = (
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    )
    return length


@_part
def _project_gaussian(camera, mean, log_scale, rotation, scales, at, slope, flat):
    """Project a Gaussian to an ellipse in the image.

    Args:
        camera: (17,) `[face_R_world row-major (9), centre (3), focal, principal (2), width,
            height]`.
        rotation: (3, 3) of the Gaussian.
        scales: (3,) filled: standard deviations.
        at: (5,) filled: mean in the camera, then x / z and y / z clamped for the affine map.
        slope: (2, 3) filled: d(u, v) / d(world) of the affine map.
        flat: (2, 3) filled: slope @ rotation @ diag(scales), a square root of the covariance.
    Returns:
        The covariance's three entries, dilated.
    """
    for r in range(3):
        at[r] = 0.0
        for k in range(3):
            at[r] += camera[3 * r + k] * (mean[k] - camera[9 + k])
        scales[r] = np.exp(log_scale[r])
    focal, z = camera[12], at[2]
    for r in range(2):
        half = 0.5 * camera[15 + r] / focal
        # slopes x / z beyond an image 1.3 times as wide are clamped in the affine map
        middle, limit = half - camera[13 + r] / focal, 1.3 * half
        at[3 + r] = min(max(at[r] / z, middle - limit), middle + limit)
    for k in range(3):
        slope[0, k] = focal / z * (camera[k] - at[3] * camera[6 + k])
        slope[1, k] = focal / z * (camera[3 + k] - at[4] * camera[6 + k])
    for r in range(2):
        for k in range(3):
            flat[r, k] = 0.0
            for m in range(3):
                flat[r, k] += slope[r, m] * rotation[m, k]
            flat[r, k] *= scales[k]
    uu = flat[0, 0] ** 2 + flat[0, 1] ** 2 + flat[0, 2] ** 2 + DILATION
    vv = flat[1, 0] ** 2 + flat[1, 1] ** 2 + flat[1, 2] ** 2 + DILATION
    uv = flat[0, 0] * flat[1, 0] + flat[0, 1] * flat[1, 1] + flat[0, 2] * flat[1, 2]
    return uu, uv, vv


@_part
def _color(offset, sh, num, basis, slopes, splat):
    """Colour of a splat (10,) at an offset (3,) from the camera, at least black."""
    distance = np.sqrt(offset[0] ** 2 + offset[1] ** 2 + offset[2] ** 2)
    x, y, z = offset[0] / distance, offset[1] / distance, offset[2] / distance
    _harmonics(x, y, z, num, basis, slopes)
    for channel in range(3):
        value = 0.5
        for k in range(num):
            value += basis[k] * sh[k, channel]
        splat[6 + channel] = max(value, 0.0)


@_kernel
def project(
    camera,
    near,
    means,
    log_scales,
    quaternions,
    logits,
    sh,
    degree,
    splats,
    reach2,
    begin,
    end,
):
    """Splats of the Gaussians begin..end - 1 in an image.

    Args:
        camera: (17,) float64, see `_project_gaussian`.
        near: Gaussians nearer in z are not rendered.
        degree: of the spherical harmonics in use; sh is (N, K, 3).
        splats: (N, 10) float32, filled, see `_tiles`.
        reach2: (N,) float32, filled: squared radius of the ellipse in which a splat's alpha is at
            least 1/255, in standard deviations; 0 = not rendered.
    """
    num = (degree + 1) ** 2
    basis, slopes, rotation = np.empty(16), np.zeros((16, 3)), np.empty((3, 3))
    scales, at, slope, flat = np.empty(3), np.empty(5), np.empty((2, 3)), np.empty((2, 3))
    offset, width, height = np.empty(3), camera[15], camera[16]
    for g in range(begin, end):
        reach2[g] = 0
        opacity = 1 / (1 + np.exp(-float(logits[g])))
        z = 0.0
        for k in range(3):
            z += camera[6 + k] * (means[g, k] - camera[9 + k])
        if z <= near or opacity * _INVERSE_MIN_ALPHA <= 1:
            continue
        _rotation(quaternions[g], rotation)
        uu, uv, vv = _project_gaussian(
            camera, means[g], log_scales[g], rotation, scales, at, slope, flat
        )
        det = uu * vv - uv * uv
        reach = 2 * np.log(opacity * _INVERSE_MIN_ALPHA)
        u = camera[12] * at[0] / z + camera[13]
        v = camera[12] * at[1] / z + camera[14]
        wide, tall = np.sqrt(reach * uu), np.sqrt(reach * vv)
        outside = u + wide < 0 or u - wide > width or v + tall < 0 or v - tall > height
        if outside or not det > 0:
            continue
        splats[g, 0], splats[g, 1] = u, v
        splats[g, 2], splats[g, 3], splats[g, 4] = vv / det, -uv / det, uu / det
        splats[g, 5], splats[g, 9] = opacity, z
        for k in range(3):
            offset[k] = means[g, k] - camera[9 + k]
        _color(offset, sh[g], num, basis, slopes, splats[g])
        reach2[g] = reach


@_part
def _through_shape(
    camera, d_splat, splat, at, slope, flat, rotation, scales, d_rotation, d_scale, d_at
):
    """Propagate the gradient of a splat's inverse covariance to the Gaussian's axes and place.

    Args:
        d_splat, splat: (10,) gradient and splat; at, slope, flat, rotation, scales: as in
            `_project_gaussian`.
        d_rotation: (3, 3) filled; d_scale: (3,) filled, of the logarithms.
        d_at: (3,) added to.
    """
    a, b, c = float(splat[2]), float(splat[3]), float(splat[4])
    p, q, r = float(d_splat[2]), 0.5 * d_splat[3], float(d_splat[4])
    # dL/dcovariance = -K [[p, q], [q, r]] K with K the inverse covariance
    left0, left1, left2, left3 = a * p + b * q, a * q + b * r, b * p + c * q, b * q + c * r
    uu, uv, vv = -(left0 * a + left1 * b), -(left0 * b + left1 * c), -(left2 * b + left3 * c)
    focal, z = camera[12], at[2]
    d_x = d_y = d_z = 0.0  # to x / z and y / z of the affine map, and to z
    for k in range(3):
        d_u = 2 * (uu * flat[0, k] + uv * flat[1, k])
        d_v = 2 * (uv * flat[0, k] + vv * flat[1, k])
        d_scale[k] = 0.0
        axis0 = axis1 = axis2 = 0.0  # the Gaussian's axis k in the camera
        for m in range(3):
            d_axis = slope[0, m] * d_u + slope[1, m] * d_v
            d_rotation[m, k] = d_axis * scales[k]
            d_scale[k] += d_axis * rotation[m, k] * scales[k]
            axis0 += camera[m] * rotation[m, k] * scales[k]
            axis1 += camera[3 + m] * rotation[m, k] * scales[k]
            axis2 += camera[6 + m] * rotation[m, k] * scales[k]
        d_x -= focal / z * d_u * axis2
        d_y -= focal / z * d_v * axis2
        d_z -= (d_u * flat[0, k] + d_v * flat[1, k]) / z
    if at[3] == at[0] / z:
        d_at[0] += d_x / z
        d_z -= d_x * at[0] / z / z
    if at[4] == at[1] / z:
        d_at[1] += d_y / z
        d_z -= d_y * at[1] / z / z
    d_at[2] += d_z


@_part
def _through_rotation(q, d_rotation, out):
    """Gradient (4,) with respect to a quaternion wxyz of any length."""
    length = np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    w, x, y, z = q[0] / length, q[1] / length, q[2] / length, q[3] / length
    d = d_rotation
    d_w = 2 * (x * (d[2, 1] - d[1, 2]) + y * (d[0, 2] - d[2, 0]) + z * (d[1, 0] - d[0, 1]))
    d_x = 2 * (y * (d[0, 1] + d[1, 0]) + z * (d[0, 2] + d[2, 0]) + w * (d[2, 1] - d[1, 2]))
    d_y = 2 * (x * (d[0, 1] + d[1, 0]) + z * (d[1, 2] + d[2, 1]) + w * (d[0, 2] - d[2, 0]))
    d_z = 2 * (x * (d[0, 2] + d[2, 0]) + y * (d[1, 2] + d[2, 1]) + w * (d[1, 0] - d[0, 1]))
    d_x -= 4 * x * (d[1, 1] + d[2, 2])
    d_y -= 4 * y * (d[0, 0] + d[2, 2])
    d_z -= 4 * z * (d[0, 0] + d[1, 1])
    along = d_w * w + d_x * x + d_y * y + d_z * z
    out[0], out[1] = (d_w - along * w) / length, (d_x - along * x) / length
    out[2], out[3] = (d_y - along * y) / length, (d_z - along * z) / length


@_part
def _through_color(d_splat, splat, sh, offset, num, basis, slopes, d_sh, d_offset):
    """Propagate the gradient of a splat's colour to its harmonics (K, 3) and its offset (3,)."""
    distance = np.sqrt(offset[0] ** 2 + offset[1] ** 2 + offset[2] ** 2)
    x, y, z = offset[0] / distance, offset[1] / distance, offset[2] / distance
    _harmonics(x, y, z, num, basis, slopes)
    d_x = d_y = d_z = 0.0
    for channel in range(3):
        d = float(d_splat[6 + channel]) if splat[6 + channel] > 0 else 0.0
        for k in range(num):
            d_sh[k, channel] = basis[k] * d
            d_x += slopes[k, 0] * sh[k, channel] * d
            d_y += slopes[k, 1] * sh[k, channel] * d
            d_z += slopes[k, 2] * sh[k, channel] * d
    along = d_x * x + d_y * y + d_z * z
    d_offset[0] = (d_x - along * x) / distance
    d_offset[1] = (d_y - along * y) / distance
    d_offset[2] = (d_z - along * z) / distance


@_kernel
def backproject(
    camera, means, log_scales, quaternions, sh, degree, splats, reach2, d_splats,
    d_means, d_log_scales, d_quaternions, d_logits, d_sh, begin, end,
):  # fmt: skip
    """Gradients of the parameters begin..end - 1 from those of their splats, d_splats (N, 10).

    The d_ arrays have the shapes of their parameters and hold zeros for splats that are not
    rendered.
    """
    num = (degree + 1) ** 2
    basis, slopes = np.empty(16), np.zeros((16, 3))
    rotation, d_rotation = np.empty((3, 3)), np.empty((3, 3))
    scales, at, slope, flat = np.empty(3), np.empty(5), np.empty((2, 3)), np.empty((2, 3))
    d_at, offset, d_offset = np.empty(3), np.empty(3), np.empty(3)
    for g in range(begin, end):
        if reach2[g] == 0:
            continue
        _rotation(quaternions[g], rotation)
        _project_gaussian(camera, means[g], log_scales[g], rotation, scales, at, slope, flat)
        d, z = d_splats[g], at[2]
        d_at[0], d_at[1] = d[0] * camera[12] / z, d[1] * camera[12] / z
        d_at[2] = d[9] - (d_at[0] * at[0] + d_at[1] * at[1]) / z
        _through_shape(
            camera,
            d,
            splats[g],
            at,
            slope,
            flat,
            rotation,
            scales,
            d_rotation,
            d_log_scales[g],
            d_at,
        )
        _through_rotation(quaternions[g], d_rotation, d_quaternions[g])
        d_logits[g] = d[5] * splats[g, 5] * (1 - splats[g, 5])
        for k in range(3):
            offset[k] = means[g, k] - camera[9 + k]
        _through_color(d, splats[g], sh[g], offset, num, basis, slopes, d_sh[g], d_offset)
        for k in range(3):
            turned = camera[k] * d_at[0] + camera[3 + k] * d_at[1] + camera[6 + k] * d_at[2]
            d_means[g, k] = d_offset[k] + turned
