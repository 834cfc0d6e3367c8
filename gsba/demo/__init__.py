"""Synthetic walks with exact truth and a SLAM-like trajectory.

Takes a path, a heading and a seed.
Gives frames or a video, the truth and a trajectory with drift and noise.
"""

from gsba.demo.degrade import degrade
from gsba.demo.mesh_walk import make_mesh_walk
from gsba.demo.walk import DemoFilm, DemoWalk, Heading, WalkPath, make_film, make_walk

__all__ = [
    "DemoFilm",
    "DemoWalk",
    "Heading",
    "WalkPath",
    "degrade",
    "make_film",
    "make_mesh_walk",
    "make_walk",
]
