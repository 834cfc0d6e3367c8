"""The typer application: how commands are registered and how they fail."""

import logging
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Annotated, NoReturn, ParamSpec

import typer

from gsba import __version__
from gsba.log import GsbaError, show_log

P = ParamSpec("P")

app = typer.Typer(
    help="Pixel-true camera poses for 360-degree video, from frames and a SLAM trajectory.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


@contextmanager
def _expected_failures() -> Iterator[None]:
    """One line on stderr and an exit code for whatever is no bug of ours."""
    try:
        yield
    except GsbaError as error:
        _fail(str(error))
    except KeyboardInterrupt:
        _fail("interrupted; run again to resume", code=130)
    except BrokenPipeError:  # `gsba ... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise typer.Exit(1) from None
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        _fail(f"{where}{error.strerror or error}")
    except MemoryError:
        _fail("out of memory: lower cubemap.max_face_size or features.max_per_face")


def _fail(message: str, code: int = 1) -> NoReturn:
    typer.echo(f"error: {message}", err=True)
    raise typer.Exit(code)


def command(function: Callable[P, None]) -> Callable[P, None]:
    """Register a command whose expected failures end in one line."""

    @wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> None:
        with _expected_failures():
            function(*args, **kwargs)

    name = function.__name__.replace("_", "-")
    return app.command(name)(run)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"gsba {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Show warnings only.")] = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Show every detail.")] = False,
    version: Annotated[
        bool,
        typer.Option(
            "--version", help="Print the version.", callback=_print_version, is_eager=True
        ),
    ] = False,
) -> None:
    show_log(logging.WARNING if quiet else logging.DEBUG if verbose else logging.INFO)
