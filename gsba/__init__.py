"""gsba: pixel-true camera poses for 360-degree video."""
