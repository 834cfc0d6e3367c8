"""Compiled passes over the tiles of an image: bin the splats, blend them, and back.

A projected splat is a row of ten float32, here and in its gradient:
`[u, v, a, b, c, opacity, red, green, blue, z]`, centre in pixels, inverse covariance
`[[a, b], [b, c]]`. A tile is 16 x 16 pixels. All loops over pixels run along whole tiles in one
flat buffer at constant offsets, so that the compiler makes vector code of them; no tile and no
(splat, tile) entry is written by two threads, so that results do not depend on their number.
"""

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from factors.compiled import kernel_and_part

TILE = 16  # pixels
CHANNELS = 5  # red, green, blue, sum of weight * z, alpha
MIN_ALPHA = np.float32(1 / 255)  # smaller alphas are not blended
MAX_ALPHA = np.float32(0.99)
MIN_TRANSMITTANCE = np.float32(1e-4)  # pixels that let less through receive no more splats

_PIXELS = TILE * TILE
_U, _V = np.uint64(0), np.uint64(_PIXELS)  # rows of a tile's buffer: pixel centres,
_T, _C = np.uint64(2 * _PIXELS), np.uint64(3 * _PIXELS)  # transmittance, five channels,
_REST = np.uint64(8 * _PIXELS)  # and the rest of the loss's slope from splats behind
_P = np.uint64(_PIXELS)
_ZERO, _ONE, _HALF, _LOG2E = (np.float32(x) for x in (0, 1, 0.5, 1.4426950408889634))
_EXP2 = tuple(np.float32(np.log(2) ** k / f) for k, f in enumerate((1, 1, 2, 6, 24, 120, 720)))
_E1, _E2, _E3, _E4, _E5, _E6 = _EXP2[1:]

_kernel, _part = kernel_and_part(
    error_model="numpy", fastmath={"contract", "reassoc", "nsz", "arcp"}
)


@intrinsic
def _nearest_whole(typing_context, value):
    """Nearest whole number of a negative float32, as float32; unlike numba's, in vector code."""

    def emit(context, builder, signature, arguments):
        down = builder.fsub(arguments[0], ir.Constant(ir.FloatType(), 0.5))
        return builder.sitofp(builder.fptosi(down, ir.IntType(32)), ir.FloatType())

    return types.float32(types.float32), emit


@intrinsic
def _power_of_two(typing_context, value):
    """2^n of a whole float32, by its exponent bits."""

    def emit(context, builder, signature, arguments):
        whole = builder.fptosi(arguments[0], ir.IntType(32))
        biased = builder.add(whole, ir.Constant(ir.IntType(32), 127))
        bits = builder.shl(biased, ir.Constant(ir.IntType(32), 23))
        return builder.bitcast(bits, ir.FloatType())

    return types.float32(types.float32), emit


@_part
def _exp(x):
    """Exponential of a float32 <= 0, to a relative 1.2e-7 (2 - x); e^-80 for anything less."""
    t = max(min(x, _ZERO), np.float32(-80.0)) * _LOG2E
    n = _nearest_whole(t)  # type: ignore[call-arg]
    f = t - n
    series = _ONE + f * (_E1 + f * (_E2 + f * (_E3 + f * (_E4 + f * (_E5 + f * _E6)))))
    return series * _power_of_two(n)  # type: ignore[call-arg]


@_kernel
def exp_of(values):
    """`_exp` of an array (N,) float32, for its test."""
    out = np.empty_like(values)
    for i in range(len(values)):
        out[i] = _exp(values[i])
    return out


@_part
def _span(splat, reach2, low, high):
    """Columns (first, last) that an ellipse of squared radius reach2 touches in rows low..high."""
    a, b, c = float(splat[2]), float(splat[3]), float(splat[4])
    det = a * c - b * b
    tall = np.sqrt(reach2 * a / det)
    low, high = max(low - splat[1], -tall), min(high - splat[1], tall)
    if low > high:
        return 1.0, 0.0
    lean = b / c * np.sqrt(reach2 * c / det)
    y_last = min(max(-lean, low), high)
    y_first = min(max(lean, low), high)
    last = (-b * y_last + np.sqrt(max(a * reach2 - det * y_last * y_last, 0.0))) / a
    first = (-b * y_first - np.sqrt(max(a * reach2 - det * y_first * y_first, 0.0))) / a
    return splat[0] + first, splat[0] + last


@_part
def _tile_columns(splat, reach2, row, num_columns):
    """Tile columns first..last - 1 whose pixel centres in a tile row may lie in the ellipse."""
    low = row * TILE + 0.5
    first, last = _span(splat, reach2, low, low + TILE - 1)
    if first > last:
        return 0, 0
    first = np.ceil(first - 0.5) // TILE
    last = np.floor(last - 0.5) // TILE + 1
    return int(max(first, 0.0)), int(min(last, float(num_columns)))


@_part
def _tile_rows(splat, reach2, num_rows):
    a, b, c = float(splat[2]), float(splat[3]), float(splat[4])
    tall = np.sqrt(reach2 * a / (a * c - b * b))
    first = max(np.ceil(splat[1] - tall - 0.5) // TILE, 0.0)
    last = min(np.floor(splat[1] + tall - 0.5) // TILE + 1, float(num_rows))
    return int(first), int(last)


@_kernel
def count_tiles(splats, reach2, num_rows, num_columns, counts, begin, end):
    """Number of tiles each splat touches; reach2 (N,) is 0 for splats that are not rendered."""
    for g in range(begin, end):
        counts[g] = 0
        if reach2[g] > 0:
            top, bottom = _tile_rows(splats[g], reach2[g], num_rows)
            for row in range(top, bottom):
                first, last = _tile_columns(splats[g], reach2[g], row, num_columns)
                counts[g] += max(last - first, 0)


@_kernel
def fill_tiles(splats, reach2, order, offsets, num_rows, num_columns, starts, owners, entries):
    """List each tile's splats from near to far, by a counting sort of splats in depth order.

    The counts of `count_tiles` are binding: if both kernels round an ellipse's border to different
    sides of a pixel, an entry without room is left out, and a superfluous one has no row.

    Args:
        order: splats by depth.
        offsets: (N + 1,) a splat's entries are offsets[g]..offsets[g + 1] - 1, tile after tile.
        starts: (tiles + 1,) filled: tile t owns rows starts[t]..starts[t + 1] - 1 of the lists.
        owners, entries: (E,) filled: splat and entry of each row; the last rows may stay unset.
    """
    tiles = np.empty(len(entries), np.int32)
    starts[:] = 0
    for g in order:
        e, end = offsets[g], offsets[g + 1]
        if end > e:
            top, bottom = _tile_rows(splats[g], reach2[g], num_rows)
            for row in range(top, bottom):
                first, last = _tile_columns(splats[g], reach2[g], row, num_columns)
                for column in range(first, min(last, first + end - e)):
                    tiles[e] = row * num_columns + column
                    starts[tiles[e] + 1] += 1
                    e += 1
        tiles[e:end] = -1
    for t in range(len(starts) - 1):
        starts[t + 1] += starts[t]
    cursor = starts[:-1].copy()
    for g in order:
        for e in range(offsets[g], offsets[g + 1]):
            if tiles[e] >= 0:
                row = cursor[tiles[e]]
                owners[row], entries[row] = g, e
                cursor[tiles[e]] += 1


@_part
def _pixel_rows(splat, reach2, top):
    """Pixels of a tile, first..last - 1 of its buffer, in the rows within a splat's reach."""
    a, b, c = float(splat[2]), float(splat[3]), float(splat[4])
    tall = np.sqrt(reach2 * a / (a * c - b * b))
    first = max(np.ceil(splat[1] - tall - 0.5) - top, 0.0)
    last = min(np.floor(splat[1] + tall - 0.5) - top + 1, float(TILE))
    return np.uint64(max(int(first), 0) * TILE), np.uint64(max(int(last), 0) * TILE)


@_part
def _start_tile(buffer, tile, num_columns):
    """Set pixel centres and full transmittance; return the tile's first pixel row and column."""
    top, left = tile // num_columns * TILE, tile % num_columns * TILE
    for i in range(_PIXELS):
        buffer[i] = np.float32(left + i % TILE + 0.5)
        buffer[_PIXELS + i] = np.float32(top + i // TILE + 0.5)
        buffer[2 * _PIXELS + i] = _ONE
    return top, left


@_part
def _is_full(buffer):
    most = _ZERO
    for i in range(2 * _PIXELS, 3 * _PIXELS):
        most = max(most, buffer[i])
    return most < MIN_TRANSMITTANCE


@_part
def _blend(buffer, splat, first, last):
    """Add a splat to the pixels first..last - 1 of a tile."""
    u, v, a, b, c = splat[0], splat[1], -_HALF * splat[2], splat[3], -_HALF * splat[4]
    opacity, red, green, blue, z = splat[5], splat[6], splat[7], splat[8], splat[9]
    for i in range(first, last):
        x, y = buffer[i + _U] - u, buffer[i + _V] - v
        alpha = min(opacity * _exp(a * x * x + c * y * y - b * x * y), MAX_ALPHA)
        through = buffer[i + _T]
        weight = alpha * through
        weight = weight if (alpha >= MIN_ALPHA) & (through >= MIN_TRANSMITTANCE) else _ZERO
        buffer[i + _C] += weight * red
        buffer[i + _C + _P] += weight * green
        buffer[i + _C + _P * np.uint64(2)] += weight * blue
        buffer[i + _C + _P * np.uint64(3)] += weight * z
        buffer[i + _C + _P * np.uint64(4)] += weight
        buffer[i + _T] = through - weight


@_kernel
def blend_tiles(splats, reach2, starts, owners, num_columns, image, used, first, last):
    """Blend the tiles first..last - 1 from near to far.

    Args:
        image: (5, rows * 16, columns * 16) float32, filled.
        used: (tiles,) filled: entries of each tile until all its pixels were full.
    """
    buffer = np.empty(8 * _PIXELS, np.float32)
    for tile in range(first, last):
        top, left = _start_tile(buffer, tile, num_columns)
        buffer[3 * _PIXELS :] = _ZERO
        row = starts[tile]
        while row < starts[tile + 1]:
            if (row - starts[tile]) % 16 == 0 and _is_full(buffer):
                break
            g = owners[row]
            begin, end = _pixel_rows(splats[g], reach2[g], top)
            _blend(buffer, splats[g], begin, end)
            row += 1
        used[tile] = row - starts[tile]
        for channel in range(CHANNELS):
            for i in range(_PIXELS):
                value = buffer[(3 + channel) * _PIXELS + i]
                image[channel, top + i // TILE, left + i % TILE] = value


@_part
def _differentiate(buffer, splat, first, last, out):
    """Gradient of the loss with respect to a splat, over the pixels first..last - 1 of a tile.

    With v = slope along the splat's colour at a pixel, dL/dalpha = T v - rest / (1 - alpha),
    where `rest` is the contribution of the splats behind to the loss's slope: the total less the
    part already replayed. So the pass runs from near to far like the one before it.
    """
    u, v, a, b, c = splat[0], splat[1], -_HALF * splat[2], splat[3], -_HALF * splat[4]
    opacity, red, green, blue, z = splat[5], splat[6], splat[7], splat[8], splat[9]
    s_x = s_y = s_xx = s_xy = s_yy = s_o = s_r = s_g = s_b = s_z = _ZERO
    for i in range(first, last):
        x, y = buffer[i + _U] - u, buffer[i + _V] - v
        bell = _exp(a * x * x + c * y * y - b * x * y)
        alpha = min(opacity * bell, MAX_ALPHA)
        through = buffer[i + _T]
        seen = (alpha >= MIN_ALPHA) & (through >= MIN_TRANSMITTANCE)
        alpha = alpha if seen else _ZERO
        weight = alpha * through
        d_red, d_green = buffer[i + _C], buffer[i + _C + _P]
        d_blue, d_z = buffer[i + _C + _P * np.uint64(2)], buffer[i + _C + _P * np.uint64(3)]
        slope = buffer[i + _C + _P * np.uint64(4)]
        slope += red * d_red + green * d_green + blue * d_blue + z * d_z
        rest = buffer[i + _REST] - weight * slope
        buffer[i + _REST] = rest
        buffer[i + _T] = through - weight
        d_alpha = through * slope - rest / (_ONE - alpha)
        d_alpha = d_alpha if seen & (alpha < MAX_ALPHA) else _ZERO
        d_power = alpha * d_alpha
        s_o += bell * d_alpha
        s_x += d_power * x
        s_y += d_power * y
        s_xx += d_power * x * x
        s_xy += d_power * x * y
        s_yy += d_power * y * y
        s_r += weight * d_red
        s_g += weight * d_green
        s_b += weight * d_blue
        s_z += weight * d_z
    out[0], out[1] = splat[2] * s_x + b * s_y, b * s_x + splat[4] * s_y
    out[2], out[3], out[4] = -_HALF * s_xx, -s_xy, -_HALF * s_yy
    out[5], out[6], out[7], out[8], out[9] = s_o, s_r, s_g, s_b, s_z


@_kernel
def differentiate_tiles(
    splats, reach2, starts, owners, entries, num_columns, image, slopes, used, out, first, last
):
    """Gradients (E, 10) of the entries of the tiles first..last - 1.

    Args:
        image: the result of `blend_tiles`.
        slopes: (5, rows * 16, columns * 16) float32, derivative of the loss for each value of it.
        out: filled at `entries`; rows of entries that were not blended stay unset.
    """
    buffer = np.empty(9 * _PIXELS, np.float32)
    for tile in range(first, last):
        top, left = _start_tile(buffer, tile, num_columns)
        buffer[8 * _PIXELS :] = _ZERO
        for channel in range(CHANNELS):
            for i in range(_PIXELS):
                slope = slopes[channel, top + i // TILE, left + i % TILE]
                buffer[(3 + channel) * _PIXELS + i] = slope
                value = image[channel, top + i // TILE, left + i % TILE]
                buffer[8 * _PIXELS + i] += slope * value
        for row in range(starts[tile], starts[tile] + used[tile]):
            g = owners[row]
            begin, end = _pixel_rows(splats[g], reach2[g], top)
            _differentiate(buffer, splats[g], begin, end, out[entries[row]])


@_kernel
def sum_entries(offsets, gradients, out, begin, end):
    """Gradients (N, 10) of splats from those of their entries, in the order of the tiles."""
    for g in range(begin, end):
        for k in range(10):
            total = 0.0
            for e in range(offsets[g], offsets[g + 1]):
                total += gradients[e, k]
            out[g, k] = total
