"""Measured records of real plants: one part to learn from, another to test on.

The files are public and are not part of the repository. KOOPMPC_RECORDS names the folder that holds them; without it
the folder `shared/data` beside the checkout is tried. Sources: DaISy, Database for the Identification of Systems
(De Moor, ed., KU Leuven), and a buck converter published with SysIdentPy's examples.
"""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

FOLDER = Path(os.environ.get("KOOPMPC_RECORDS", Path(__file__).parents[3] / "shared" / "data"))


@dataclass(frozen=True)
class Record:
    """Inputs and outputs of one plant; row k of U is the input recorded beside row k of Y.

    Attributes
    ----------
    name, unit
        Name of the record, and the unit of its error.
    dt
        Sample time [s].
    inputs, outputs
        Names of the columns.
    U_learn, Y_learn
        (rows, nu) and (rows, ny), the part to learn from.
    U_test, Y_test
        (rows, nu) and (rows, ny), the part to test on.
    known
        How many first rows of Y_test a free run is told.
    """

    name: str
    unit: str
    dt: float
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    U_learn: np.ndarray
    Y_learn: np.ndarray
    U_test: np.ndarray
    Y_test: np.ndarray
    known: int

    def error(self, Y: np.ndarray) -> float:
        """Return the root-mean-square error of a free run over the rows that it was not told.

        Several outputs have different units: each counts relative to its standard deviation over the test part.
        """
        gap = np.asarray(Y)[self.known :] - self.Y_test[self.known :]
        if gap.shape[1] > 1:
            gap = gap / self.Y_test.std(axis=0)
        with np.errstate(over="ignore", invalid="ignore"):
            error = float(np.sqrt(np.mean(gap**2)))
        return error if np.isfinite(error) else float("inf")

    @property
    def diverged(self) -> float:
        """Error from which a free run counts as diverged: ten ranges of the learning part."""
        return 10.0 * float(np.ptp(self.Y_learn, axis=0).max() if len(self.outputs) == 1 else 1.0)


def _cut(name: str, unit: str, dt: float, names: tuple[str, str], U: np.ndarray, Y: np.ndarray, at: int, end: int,
         known: int) -> Record:  # fmt: skip
    return Record(name, unit, dt, (names[0],), (names[1],), U[:at], Y[:at], U[at:end], Y[at:end], known)


def _table(file: str, header: bool = True) -> np.ndarray:
    return np.loadtxt(FOLDER / file, delimiter="," if header else None, skiprows=int(header))


def _robot_arm() -> Record:
    table = _table("daisy_robot-arm.csv")
    return _cut("robot arm", "1", 0.002, ("torque", "acceleration"), table[:, :1], table[:, 1:], 512, 1024, 10)


def _exchanger() -> Record:
    table = _table("daisy_exchanger.csv")
    names = ("liquid flow", "outlet temperature [degC]")
    return _cut("heat exchanger", "degC", 1.0, names, table[:, 1:2], table[:, 2:], 3000, 4000, 25)


def _ball_and_beam() -> Record:
    table = _table("daisy_ball-and-beam.csv")
    return _cut("ball and beam", "1", 0.1, ("beam input", "position"), table[:, :1], table[:, 1:], 500, 1000, 10)


def _reactor() -> Record:
    table = _table("daisy_cstr.dat", header=False)
    U, Y = table[:, 1:2], table[:, 2:]
    names = ("concentration [mol/l]", "temperature [K]")
    return Record(
        "reactor", "spreads", 6.0, ("coolant flow [l/min]",), names, U[:5000], Y[:5000], U[5000:7500], Y[5000:7500], 10
    )


def _buck() -> Record:
    learn, test = _table("buck_id.csv"), _table("buck_valid.csv")
    names = ("input voltage [V]",), ("output voltage [V]",)
    return Record("buck converter", "V", 1e-5, *names, learn[:, 1:2], learn[:, 2:], test[:, 1:2], test[:, 2:], 10)


RECORDS: dict[str, Callable[[], Record]] = {
    "robot arm": _robot_arm,
    "heat exchanger": _exchanger,
    "ball and beam": _ball_and_beam,
    "reactor": _reactor,
    "buck converter": _buck,
}
