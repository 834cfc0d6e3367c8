"""The command line. Commands parse, call and print; heavy imports stay in their bodies."""

from gsba.cli import refining, results, splat, videos
from gsba.cli.app import app

__all__ = ["app", "main", "refining", "results", "splat", "videos"]


def main() -> None:
    """Entry point of the `gsba` script."""
    app()
