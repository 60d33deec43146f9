"""The founding paper of Snyder & Song: its settings, theory, control and figures."""

from .figures import paper as paper
