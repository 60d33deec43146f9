"""Acting: how the inputs of loops act on stand-ins, more or less than in the data, and a little late."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int


@dataclass(frozen=True, eq=False)
class Acting:
    """v_k = u_0 + gain ((1 − late) u_k + late u_{k−1} − u_0), with a gain and a delay for each of E loops.

    An input that comes a share `late` of a step late has this mean over the step, with that of the step before.

    Attributes
    ----------
    middle
        (nu,) u_0, the mean of the data's inputs.
    gain, late
        (E,) factors on the inputs, and delays as shares of a step.
    """

    middle: Float[np.ndarray, " nu"]
    gain: Float[np.ndarray, " E"]
    late: Float[np.ndarray, " E"]

    def take(self, place: int) -> "Acting":
        """Return that of one loop."""
        return Acting(self.middle, self.gain[[place]], self.late[[place]])

    def change(
        self, U: Float[np.ndarray, "n nu"], before: Float[np.ndarray, "n nu"], which: Int[np.ndarray, " n"]
    ) -> Float[np.ndarray, "n nu"]:
        """Return what acts in the loops `which`; at the first step `before` is U itself."""
        late, gain = self.late[which, None], self.gain[which, None]
        return self.middle + gain * ((1 - late) * U + late * before - self.middle)
