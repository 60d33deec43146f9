"""``python -m koopmpc`` is ``koopmpc``."""

from koopmpc.apps.cli import app

app(prog_name="koopmpc")
