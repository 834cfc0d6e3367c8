"""The demo's scene: a small picture gallery around an inner block, lit from above."""

import numpy as np

from gsba.demo import textures
from gsba.demo.mesh import MeshBuilder
from gsba.demo.pictures import picture
from gsba.demo.raycast import Scene

HALF_X, HALF_Z, HEIGHT = 7.0, 5.0, 3.8  # outer walls and ceiling, units
BLOCK_X, BLOCK_Z = 2.5, 0.9  # half extent of the inner block
DOOR_X, DOOR_HEIGHT = 0.75, 2.5  # passage through the block
TEXELS = 110.0  # per unit on walls and floor
SOUTH, NORTH, WEST, EAST = (0, 0, -1), (0, 0, 1), (-1, 0, 0), (1, 0, 0)


def build_gallery(seed: int = 0) -> Scene:
    """Gallery with its floor at y = 0, centred on the y axis; the seed changes every texture."""
    rng = np.random.default_rng(seed)
    mesh = MeshBuilder(seed)
    _shell(mesh, rng)
    _inner_block(mesh, rng)
    _hang_pictures(mesh, rng)
    _furnish(mesh, rng)
    return mesh.build()


def _texels(units: float) -> int:
    return int(np.ceil(units * TEXELS))


def _shell(mesh: MeshBuilder, rng: np.random.Generator) -> None:
    """Add floor, ceiling with beams and lamps, outer walls, two screens, columns."""
    wide, deep, tall = _texels(2 * HALF_X), _texels(2 * HALF_Z), _texels(HEIGHT)
    x, z = (-HALF_X, HALF_X), (-HALF_Z, HALF_Z)
    floor = mesh.texture(textures.terrazzo(rng, deep, wide), TEXELS)
    ceiling = mesh.texture(textures.plaster(rng, deep, wide, (206, 202, 194)), TEXELS)
    mesh.level(x, z, 0.0, floor, up=True)
    mesh.level(x, z, -HEIGHT, ceiling, up=False)
    paints = ((204, 196, 182), (146, 164, 160), None, (190, 160, 128))
    for facing, paint in zip((SOUTH, NORTH, WEST, EAST), paints, strict=True):
        width = 2 * HALF_Z if facing[0] else 2 * HALF_X
        size = (tall, _texels(width))
        image = textures.brick(rng, *size) if paint is None else textures.plaster(rng, *size, paint)
        center = -np.array(facing) * [HALF_X, 0, HALF_Z] - [0, HEIGHT / 2, 0]
        mesh.panel(center, facing, (width, HEIGHT), mesh.texture(image, TEXELS))
    oak = mesh.texture(textures.wood(rng, 300, 1500, (126, 88, 56)), TEXELS)
    for at in np.arange(-6, 7, 2.0):
        mesh.box((at - 0.12, at + 0.12), z, (HEIGHT - 0.28, HEIGHT - 1e-4), oak)
    white = mesh.texture(np.full((8, 8, 3), 255, np.uint8))
    for at in (-5, -1, 3):
        for side in (-3.1, 3.1):
            centre = at + rng.uniform(-0.2, 0.2) + (1 if side > 0 else 0)
            lamp = (centre - 0.55, centre + 0.55)
            mesh.level(lamp, (side - 0.55, side + 0.55), -HEIGHT + 0.02, white, False, 22.0)
    for side in (-6.2, 6.2):
        mesh.level((side - 0.3, side + 0.3), (-0.9, 0.9), -HEIGHT + 0.02, white, False, 22.0)
    paint = mesh.texture(textures.plaster(rng, tall, 300, (120, 66, 58)), TEXELS)
    mesh.box((1.7, 1.95), (HALF_Z - 1.5, HALF_Z), (0, 3.0), paint)
    mesh.box((-1.95, -1.7), (-HALF_Z, -HALF_Z + 1.5), (0, 3.0), paint)
    for at_x, at_z, tone in (
        (-5.8, -3.7, (70, 110, 116)),
        (5.8, -3.7, (150, 96, 62)),
        (-5.8, 3.7, (156, 130, 76)),
        (5.8, 3.7, (92, 84, 116)),
    ):
        tiles = mesh.texture(textures.mosaic(rng, tall, 256, tone), TEXELS)
        mesh.column(at_x, at_z, 0.24, (0, HEIGHT), tiles)


def _inner_block(mesh: MeshBuilder, rng: np.random.Generator) -> None:
    """Add two blocks with a passage between them and a lintel above it."""
    tall = _texels(HEIGHT)
    bricks = mesh.texture(textures.brick(rng, tall, _texels(2 * BLOCK_X)), TEXELS)
    paint = mesh.texture(textures.plaster(rng, tall, 600, (176, 182, 172)), TEXELS)
    z = (-BLOCK_Z, BLOCK_Z)
    mesh.box((-BLOCK_X, -DOOR_X), z, (0, HEIGHT), bricks)
    mesh.box((DOOR_X, BLOCK_X), z, (0, HEIGHT), paint)
    mesh.box((-DOOR_X, DOOR_X), z, (DOOR_HEIGHT, HEIGHT), paint)


def _hang_pictures(mesh: MeshBuilder, rng: np.random.Generator) -> None:
    """Add pictures of random sizes along every wall, 3 cm thick."""
    dark = mesh.texture(np.full((8, 8, 3), 40, np.uint8))
    half_x, half_z = HALF_X - 0.5, HALF_Z - 0.5
    walls = (  # facing, distance of the wall along -facing, stretch of the wall to fill
        (SOUTH, HALF_Z, (-half_x, 1.4)),
        (SOUTH, HALF_Z, (2.3, half_x)),
        (NORTH, HALF_Z, (-half_x, -2.3)),
        (NORTH, HALF_Z, (-1.4, half_x)),
        (WEST, HALF_X, (-half_z, half_z)),
        (EAST, HALF_X, (-half_z, -1.4)),
        (EAST, HALF_X, (1.4, half_z)),
        (SOUTH, -BLOCK_Z, (-BLOCK_X + 0.1, -DOOR_X)),
        (SOUTH, -BLOCK_Z, (DOOR_X, BLOCK_X - 0.1)),
        (NORTH, -BLOCK_Z, (-BLOCK_X + 0.1, -DOOR_X)),
        (NORTH, -BLOCK_Z, (DOOR_X, BLOCK_X - 0.1)),
        (WEST, -BLOCK_X, (-BLOCK_Z, BLOCK_Z)),
        (EAST, -BLOCK_X, (-BLOCK_Z, BLOCK_Z)),
        (WEST, 1.7, (half_z - 0.9, HALF_Z)),
        (EAST, -1.95, (half_z - 0.9, HALF_Z)),
        (WEST, -1.95, (-HALF_Z, -half_z + 0.9)),
        (EAST, 1.7, (-HALF_Z, -half_z + 0.9)),
    )
    style = 0
    for facing, distance, (start, end) in walls:
        along = np.abs(np.cross(facing, (0, 1, 0)))
        at = start + rng.uniform(0.1, 0.3)
        while (room := end - at - 0.1) > 0.6:
            width = min(rng.uniform(0.7, 1.7), room)
            height = min(width * rng.uniform(0.75, 1.4), 1.6)
            texels = int(150 * height), int(150 * width)
            image = mesh.texture(picture(rng, *texels, style))
            middle = -1.65 + rng.uniform(-0.15, 0.15)  # middle of the pictures at eye level
            center = (at + width / 2) * along - distance * np.array(facing) + [0, middle, 0]
            front = center + 0.03 * np.array(facing)
            mesh.panel(front, facing, (width, height), image)
            for sign in (-1, 1):
                side = center + sign * along * width / 2 + 0.015 * np.array(facing)
                mesh.panel(side, sign * along, (0.03, height), dark)
            at += width + rng.uniform(0.25, 0.6)
            style += 1


def _furnish(mesh: MeshBuilder, rng: np.random.Generator) -> None:
    """Add benches, plinths with stones, a bookcase, crates and two rugs."""
    oak = mesh.texture(textures.wood(rng, 200, 400, (152, 104, 62)), 140.0)
    walnut = mesh.texture(textures.wood(rng, 200, 400, (92, 62, 44)), 140.0)
    for x, z in (
        ((-4.6, -3.0), (4.0, 4.4)),
        ((2.9, 4.5), (-4.4, -4.0)),
        ((-0.7, 0.7), (-4.5, -4.1)),
    ):
        mesh.box(x, z, (0.38, 0.46), oak)
        for leg in (x[0] + 0.12, x[1] - 0.22):
            mesh.box((leg, leg + 0.1), (z[0] + 0.05, z[1] - 0.05), (0, 0.38), walnut)
    marble = mesh.texture(textures.plaster(rng, 256, 256, (214, 210, 204)), TEXELS)
    stone = mesh.texture(textures.terrazzo(rng, 256, 256), 150.0)
    for x, z, height in ((-6.3, -4.3, 1.0), (6.3, 4.3, 0.8), (6.3, -4.3, 1.1), (0.2, 4.2, 0.9)):
        mesh.box((x - 0.22, x + 0.22), (z - 0.22, z + 0.22), (0, height), marble)
        mesh.boulder((x, -height - 0.22, z), 0.27, stone)
    shelves = mesh.texture(textures.books(rng, 360, 400, 6))
    mesh.box((-HALF_X, -HALF_X + 0.35), (-1.25, 1.25), (0, 2.2), walnut)
    mesh.panel((-HALF_X + 0.352, -1.12, 0), EAST, (2.4, 2.1), shelves)
    for x, z, size in ((5.9, 0.6, 0.6), (6.1, -0.2, 0.45), (-6.4, 4.4, 0.7), (6.0, 0.65, 0.35)):
        bottom = 0.6 if size == 0.35 else 0.0
        half = size / 2
        mesh.box((x - half, x + half), (z - half, z + half), (bottom, bottom + size), oak, walnut)
    for x, z in (((-4.9, -2.9), (1.6, 3.1)), ((2.6, 4.8), (-3.2, -1.7))):
        mesh.level(x, z, -0.01, mesh.texture(textures.rug(rng, 190, 260)), up=True)
