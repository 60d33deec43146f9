"""The command line."""

from koopmpc.cli.app import app as app
