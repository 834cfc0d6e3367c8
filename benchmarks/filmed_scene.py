"""Things in front of a filmed camera that scenes of `gsba demo` lack: a door, a curtain, a mirror.

They stand in the gallery, and are lit evenly, without shadows. The mirror shows neither the camera
nor people.
"""

import numpy as np

from gsba.demo.mesh import MeshBuilder
from gsba.demo.pictures import picture
from gsba.demo.raycast import Scene
from gsba.demo.render import Eye, render_eye

DOOR_HINGE, DOOR_SIZE = np.array([-0.75, -2.4, -0.92]), (1.1, 2.4)  # beside the passage, units
DOOR_OPENS, DOOR_DEG = (0.2, 0.35), 100.0  # shares of the walk's time, turn
CURTAIN_CORNER, CURTAIN_SIZE = np.array([-4.5, -3.2, -4.8]), (2.4, 3.0)  # at the wall z = -5
CURTAIN_FACES, CURTAIN_SWING = (24, 6), 0.12  # columns and rows, units at its lower edge
MIRROR_CENTRE, MIRROR_SIZE = np.array([-1.2, -1.5, 4.94]), (2.0, 1.2)  # at the wall z = 5
_DOWN = np.array([0.0, 1.0, 0.0])


def furnished(scene: Scene, effects: frozenset[str], share: float, time: float) -> Scene:
    """The scene with the things among `effects` as they stand at a time.

    Args:
        share: of the walk's time that has passed.
        time: seconds.
    """
    mesh, rng = MeshBuilder(), np.random.default_rng(5)
    if "door" in effects:
        opened = np.clip((share - DOOR_OPENS[0]) / (DOOR_OPENS[1] - DOOR_OPENS[0]), 0, 1)
        angle = np.radians(DOOR_DEG) * opened**2 * (3 - 2 * opened)
        leaf = DOOR_SIZE[0] * np.array([np.cos(angle), 0, -np.sin(angle)])
        image = mesh.texture(picture(rng, 480, 220, 1))
        mesh.face(DOOR_HINGE, leaf, DOOR_SIZE[1] * _DOWN, image)
    if "curtain" in effects:
        _hang_curtain(mesh, rng, time)
    if "mirror" in effects:  # the last face
        black = mesh.texture(np.zeros((8, 8, 3), np.uint8))
        mesh.panel(MIRROR_CENTRE, (0, 0, -1), MIRROR_SIZE, black)
    return _joined(scene, mesh.build()) if effects & {"door", "curtain", "mirror"} else scene


def _hang_curtain(mesh: MeshBuilder, rng: np.random.Generator, time: float) -> None:
    """Add a cloth of triangles that waves, most at its lower edge."""
    columns, rows = CURTAIN_FACES
    a, b = np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1))
    folds = np.sin(22 * a - 2.6 * time) + 0.7 * np.sin(9 * a + 2 * b + 1.7 * time)
    depth = CURTAIN_SWING / 1.7 * (0.3 + 0.7 * b) * folds
    knots = np.stack([CURTAIN_SIZE[0] * a, CURTAIN_SIZE[1] * b, depth], axis=-1) + CURTAIN_CORNER
    cloth = picture(rng, 480, 384, 2)
    height, width = cloth.shape[0] // rows, cloth.shape[1] // columns
    for j in range(rows):
        for i in range(columns):
            piece = cloth[j * height : (j + 1) * height, i * width : (i + 1) * width]
            here, right, below, last = (knots[j + y, i + x] for y in (0, 1) for x in (0, 1))
            image = mesh.texture(piece)
            mesh.face(here, right - here, below - here, image, triangle=True)
            image = mesh.texture(piece[::-1, ::-1].copy())
            mesh.face(last, below - last, right - last, image, triangle=True)


def _joined(scene: Scene, other: Scene) -> Scene:
    """Both scenes in one, whose hierarchy has two roots."""
    faces, nodes = len(scene.corners), len(scene.node_skip)
    moved = other._replace(
        textures=other.textures + len(scene.levels),
        node_skip=other.node_skip + nodes,
        node_face=np.where(other.node_face < 0, -1, other.node_face + faces),
        levels=other.levels + np.array([len(scene.texels), 0, 0]),
        light_grids=other.light_grids + np.array([len(scene.light), 0, 0]),
    )
    return Scene(*(np.concatenate(pair) for pair in zip(scene, moved, strict=True)))


def seen(scene: Scene, eye: Eye, width: int, mirror: bool) -> np.ndarray:
    """Picture (width / 2, width, 3) of an eye as by `render_eye`; `mirror`: the last texture of the
    scene is a mirror, in which the eye sees what the mirrored eye sees from behind it."""
    size = width, width // 2
    shown = render_eye(scene, eye, *size)
    if mirror:
        glass = scene.textures == len(scene.levels) - 1
        glowing = scene._replace(emissions=np.where(glass, 1e3, scene.emissions))
        share = (render_eye(glowing, eye, *size) - shown) / 255
        low = scene.corners[:, 2] + np.minimum(scene.edges[..., 2], 0).sum(axis=1)
        room = scene._replace(spans=np.where(low > MIRROR_CENTRE[2] - 1e-6, -1, scene.spans))
        eyes = eye.world_T_eyes * np.array([1, 1, -1])[:, None]
        eyes[:, 2, 3] += 2 * MIRROR_CENTRE[2]
        shown += share * render_eye(room, eye._replace(world_T_eyes=eyes), *size)
    return shown
