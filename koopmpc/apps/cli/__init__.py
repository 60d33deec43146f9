"""The command line: `app` is the program."""

import sys
from typing import Any

from koopmpc.apps.cli.ending import ENDING


def app(*arguments: Any, **options: Any) -> None:
    """Run the program; Ctrl-C and SIGTERM end it within a second, with exit code 130 and one line.

    The handlers stand before the commands are imported, which takes a part of a second.
    """
    with ENDING:
        from koopmpc.apps.cli.app import app as commands

        if not arguments and len(sys.argv) == 1:
            arguments = (["start"],)
        commands(*arguments, **options)
    sys.exit(0)
