"""``python -m koopmpc`` is ``koopmpc``."""

from koopmpc.cli.app import app

app(prog_name="koopmpc")
