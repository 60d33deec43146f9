"""The beartype decorator that the jaxtyping import hook uses in tests (ints pass for floats)."""

from beartype import BeartypeConf, beartype

beartyped = beartype(conf=BeartypeConf(is_pep484_tower=True))
