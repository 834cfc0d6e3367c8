"""gsba: pixel-true camera poses for 360-degree video."""

__version__ = "0.1.0"
