"""Observables ψ(x): one family a file."""

# `a + b` and `a * b` import them only when they are called, and files and tasks that hold one are read before
from koopmpc.lifting.product import Product as Product
from koopmpc.lifting.sum import Sum as Sum
