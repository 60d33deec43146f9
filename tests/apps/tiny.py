"""A problem file that runs in a moment, and ways to break it."""

from pathlib import Path

SOURCE = '''"""Tiny: a leaky tank of one state.

More lines that nobody lists.
"""

from dataclasses import dataclass

import casadi as ca
import koopmpc as km


@dataclass(frozen=True)
class Tiny(km.Dynamics):
    states = ("level [m]",)
    inputs = ("flow [m/s]",)

    def rhs(self, x, u):
        return -0.5 * x[0] + 0.2 * ca.sin(x[0]) + u[0]


problem = km.Problem(
    dynamics=Tiny(),
    dt=0.1,
    equilibrium=([0.0], [0.0]),
    training=km.Training(km.Uniform([-2.0], [2.0]), km.Noise(-2.0, 2.0), episodes=20, steps=5),
    lifting=km.State() + km.Fourier(1) + km.Constant(),
    cost=km.Cost(Q=1.0, R=0.1),
    limits=km.Limits(u_min=-2.0, u_max=2.0),
    horizon=5,
    cases={
        "near": km.Case(x0=[0.5], reference=[0.0], steps=40),
        "far": km.Case(x0=[1.0], reference=[0.0], steps=6, limits=km.Limits(u_min=-1.0, u_max=1.0)),
    },
    scene=lambda x, u: [km.scene.Disk("level", (0.0, float(x[0])), 0.1)],
)
'''


def write(folder: Path, name: str = "tiny", **replaced: str) -> Path:
    """Write the problem as <folder>/<name>.py; `replaced` is old text → new text, which must occur."""
    text = SOURCE
    for old, new in replaced.items():
        assert old in text
        text = text.replace(old, new)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.py"
    path.write_text(text)
    return path
