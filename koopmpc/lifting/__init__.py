"""Observables ψ(x): one family a file."""

# `a * b` imports it only when it is called, and files and tasks that hold one are read before
from koopmpc.lifting.product import Product as Product
