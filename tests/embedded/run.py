"""`make embedded`: float controllers on an emulated Cortex-M4F, beside the same C on this machine.

They are those of three problems, a BilinearMPC, and the cart-pole of LinearMPC.jl's benchmark.

It needs the Debian packages gcc-arm-none-eabi, libnewlib-arm-none-eabi and qemu-system-arm, and says so where one is missing.
"""

import re
import shutil
import struct
import subprocess
import sys
import tempfile
from pathlib import Path

import casadi as ca
import numpy as np
from scipy.signal import cont2discrete

import koopmpc as km

HERE = Path(__file__).parent
PROBLEMS = ("pendulum:upright", "cart_pole", "pendulum_swing", "pendulum_swing bilinear")
HORIZONS = (50, 125)  # of LinearMPC.jl's cart-pole
STEPS, CLOSE = 200, 1e-3
TOOLS = {
    "arm-none-eabi-gcc": "gcc-arm-none-eabi and libnewlib-arm-none-eabi",
    "qemu-system-arm": "qemu-system-arm",
}
CPU = ("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16")
LIBRARIES = ("-lm", "-lc", "-lgcc", "--specs=nosys.specs")
TICK = 40  # instructions, see board.c


def say(line: str) -> None:
    """Show a line at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main() -> int:
    """Print a line a problem; 0 where all agree or a tool is missing."""
    missing = [package for tool, package in TOOLS.items() if shutil.which(tool) is None]
    if missing:
        say(f"make embedded needs the Debian packages {', '.join(missing)}; nothing was run")
        return 0
    say(f"{'problem':<25}{'flash':>9}{'state':>9}{'stack':>8}{'instructions a step':>30}{'off host':>11}")
    failed = False
    for name in PROBLEMS:
        with tempfile.TemporaryDirectory() as folder:
            failed |= not shown(name, exported(name, Path(folder)))
    for N in HORIZONS:
        with tempfile.TemporaryDirectory() as folder:
            failed |= not shown(f"LinearMPC.jl's, N {N}", exported_benchmark(N, Path(folder)))
    return int(failed)


def exported(name: str, folder: Path) -> Path:
    """Export the Koopman MPC of a problem, or its BilinearMPC, in single precision, its example on the problem's own plant."""
    name, _, bilinear = name.partition(" ")
    problem = km.load_problem(name)
    parts = km.bench.Prepared(problem)
    case = next(iter(problem.cases.values()))
    limits = problem.limits if case.limits is None else case.limits
    if bilinear:
        controller = km.BilinearMPC(parts.bilinear, problem.cost, limits, problem.horizon)
    else:
        controller = km.KoopmanMPC(parts.model, problem.cost, limits, problem.horizon, solver="daqp")
    row = np.atleast_2d(np.asarray(case.reference))[0]
    return km.export(
        controller, folder / "c", precision="float", plant=parts.step_map, x0=case.x0, reference=row, steps=STEPS
    )


def exported_benchmark(N: int, folder: Path) -> Path:
    """Export the cart-pole of LinearMPC.jl's benchmark in single precision, from 0.2 rad to a set point 1 m away."""
    A = np.array([[0, 1, 0, 0], [0, -10, 9.81, 0], [0, 0, 0, 1], [0, -20, 39.24, 0]])
    A, B, *_ = cont2discrete((A, 100 * np.array([[0], [1], [0], [2.0]]), np.eye(4), np.zeros((4, 1))), 0.01)
    x, u = ca.SX.sym("x", 4), ca.SX.sym("u", 1)
    model = km.LinearPredictor(A, B, np.eye(4), km.State(), 0.01, ("p", "v", "theta", "omega"), ("u",))
    plant = km.StepMap(ca.Function("F", [x, u], [ca.DM(A) @ x + ca.DM(B) @ u]), 0.01, states=model.states)
    cost, end = km.Cost(Q=[1.44, 0, 1, 0], R=0.0, R_delta=0.01, tail=0), np.array([np.inf, np.inf, 0.3, np.inf])
    controller = km.KoopmanMPC(model, cost, km.Limits(-2, 2, x_min=-end, x_max=end, slack=(0.0, 1e3)), N)
    x0, row = [0.0, 0.0, 0.2, 0.0], [1.0, 0.0, 0.0, 0.0]
    return km.export(controller, folder / "c", precision="float", plant=plant, x0=x0, reference=row, steps=STEPS)


def shown(name: str, folder: Path) -> bool:
    """Build, run, compare and print; tell whether board and host agree."""
    host = subprocess.run(["make", "-s", "run"], cwd=folder, capture_output=True, text=True, check=True).stdout
    expected = np.array([[float(word) for word in line.split(",")] for line in host.splitlines()[1:]])
    image = folder / "board.elf"
    sources = [*sorted(folder.glob("koopmpc_*.c")), folder / "plant.c", HERE / "board.c"]
    flags = (
        "-o",
        str(image),
        "-std=gnu99",
        "-O2",
        "-ffunction-sections",
        "-fdata-sections",
        "-Wl,--gc-sections",
        "-nostartfiles",
    )
    subprocess.run(
        [
            "arm-none-eabi-gcc",
            *CPU,
            *flags,
            f"-I{folder}",
            f"-T{HERE / 'cortex_m4.ld'}",
            *map(str, sources),
            *LIBRARIES,
        ],
        check=True,
        capture_output=True,
    )
    size = subprocess.run(["arm-none-eabi-size", str(image)], capture_output=True, text=True, check=True).stdout
    text, data, bss = (int(word) for word in size.splitlines()[1].split()[:3])
    machine = ["-M", "mps2-an386", "-nographic", "-monitor", "none", "-serial", "none", "-icount", "shift=0"]
    # what semihosting says goes to stderr
    done = subprocess.run(
        ["qemu-system-arm", *machine, "-semihosting-config", "enable=on,target=native", "-kernel", str(image)],
        capture_output=True,
        text=True,
        timeout=300,
    )
    lines = (done.stdout + done.stderr).splitlines()
    rows = [line.split() for line in lines if re.fullmatch(r"([0-9a-f]{8} )+[0-9a-f]{8}", line)]
    stack = next((int(line.split()[1], 16) for line in lines if line.startswith("stack ")), 0)
    if len(rows) != STEPS:
        say(f"{name:<25} ended after {len(rows)} of {STEPS} steps: {lines[-1:]}")
        return False
    width = expected.shape[1] - 4
    found = np.array([[struct.unpack(">f", bytes.fromhex(word))[0] for word in row[1 : 1 + width]] for row in rows])
    instructions = TICK * np.array([int(row[-1], 16) for row in rows])
    scale = np.abs(expected[:, 1 : 1 + width]).max(axis=0) + 1e-9
    off = float((np.abs(found - expected[:, 1 : 1 + width]) / scale).max())
    steps = f"{int(np.median(instructions))} median, {instructions.max()} worst"
    say(f"{name:<25}{text + data:>9}{data + bss:>9}{stack:>8}{steps:>30}{off:>11.1e}")
    return off <= CLOSE


if __name__ == "__main__":
    sys.exit(main())
