"""The command line. Commands parse, call and print; heavy imports stay in their bodies."""

from gsba.cli import growing, making, preparing, refining, results, serving, showing, splat  # noqa: F401
from gsba.cli.app import app


def main() -> None:
    """Entry point of the `gsba` script."""
    app()
