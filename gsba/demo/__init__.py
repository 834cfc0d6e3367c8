"""A synthetic walk with exact truth, and the SLAM-like trajectory made from it.

Takes a path, a heading and a seed.
Gives frames, the truth and a spoiled trajectory.
"""

from gsba.demo.degrade import degrade
from gsba.demo.mesh_walk import make_mesh_walk
from gsba.demo.walk import DemoWalk, Heading, WalkPath, make_walk

__all__ = ["DemoWalk", "Heading", "WalkPath", "degrade", "make_mesh_walk", "make_walk"]
