"""The command line as tests call it."""

from click.testing import Result
from typer.testing import CliRunner

from koopmpc.apps.cli.app import app


def koopmpc(*arguments: object) -> Result:
    """Return what `koopmpc ARGUMENTS` printed, and its exit code."""
    return CliRunner().invoke(app, [str(argument) for argument in arguments])
