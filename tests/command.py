"""The command line, called within the process."""

from typer.testing import CliRunner, Result

from gsba.cli import app


def run_gsba(*arguments: object) -> Result:
    """Output and exit code of `gsba` with these arguments."""
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def succeed(*arguments: object) -> Result:
    """Output of `gsba` with these arguments, which must end with exit code 0."""
    result = run_gsba(*arguments)
    assert result.exit_code == 0, result.output
    return result


def fails(result: Result, message: str, code: int = 1) -> None:
    """The command ended with exactly one line on stderr and nothing on stdout."""
    lines = result.stderr.splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: "), result.stderr
    assert message in lines[0], lines[0]
    assert (result.exit_code, result.stdout) == (code, "")
