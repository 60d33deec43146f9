"""``python -m koopmpc`` is ``koopmpc``."""

from koopmpc.cli import app

app(prog_name="koopmpc")
