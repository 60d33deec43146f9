"""Maximal-length binary sequences from linear feedback shift registers."""

from functools import lru_cache

import numpy as np
from jaxtyping import Bool

# Feedback taps of a primitive polynomial for each order (Golomb, Shift Register Sequences, 1967).
_TAPS = {
    3: (3, 2),
    4: (4, 3),
    5: (5, 3),
    6: (6, 5),
    7: (7, 6),
    8: (8, 6, 5, 4),
    9: (9, 5),
    10: (10, 7),
    11: (11, 9),
    12: (12, 6, 4, 1),
    13: (13, 4, 3, 1),
    14: (14, 5, 3, 1),
    15: (15, 14),
    16: (16, 15, 13, 4),
}
ORDERS = tuple(_TAPS)


@lru_cache
def maximal_length(order: int) -> Bool[np.ndarray, " period"]:
    """Return one period b_k = b_{k−t₁} ⊕ b_{k−t₂} ⊕ …, of 2^order − 1 bits, read-only.

    Its ones exceed its zeros by one and its periodic autocorrelation is −1 off zero (levels ±1): the spectrum
    is flat but for the mean.
    """
    period = 2**order - 1
    bits = [True] * order
    for k in range(order, period):
        bits.append(sum(bits[k - tap] for tap in _TAPS[order]) % 2 == 1)
    sequence = np.array(bits)
    sequence.flags.writeable = False
    return sequence
