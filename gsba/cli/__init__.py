"""The command line. Commands parse, call and print; heavy imports stay in their bodies."""

from gsba.cli import (
    checking,
    growing,
    inspecting,
    localizing,
    making,
    plotting,
    preparing,
    refining,
    results,
    serving,
    splat,
    tracking,
    viewing,
)
from gsba.cli.app import app

__all__ = [
    "app",
    "checking",
    "growing",
    "inspecting",
    "localizing",
    "main",
    "making",
    "plotting",
    "preparing",
    "refining",
    "results",
    "serving",
    "splat",
    "tracking",
    "viewing",
]


def main() -> None:
    """Entry point of the `gsba` script."""
    app()
