"""The beartype decorator that the jaxtyping import hook uses in tests: ints pass for floats, tuples for arrays."""

from beartype import BeartypeConf, beartype
from numpy._typing._nested_sequence import _NestedSequence

_NestedSequence.register(tuple)  # numpy takes a tuple as ArrayLike, though it has no __reversed__
beartyped = beartype(conf=BeartypeConf(is_pep484_tower=True))
