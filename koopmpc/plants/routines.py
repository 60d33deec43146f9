"""CasADi functions on numpy arrays, run by the interpreter or as machine code from the C that CasADi generates."""

import _ctypes
import ctypes
import os
import platform
import shlex
import shutil
import stat
import subprocess
import tempfile
import threading
import weakref
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache as remember
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc.base.interrupts import raise_swallowed
from koopmpc.base.values import fingerprint

Kernel = Callable[[Float[np.ndarray, "E rows nx"], Float[np.ndarray, "E T nu"]], None]

# Without fused multiply-adds and -march the machine code gives the interpreter's numbers on all machines of a kind.
_FLAGS = ("-ffp-contract=off", "-fno-math-errno", "-fPIC", "-shared")
_NATIVE = ("-march=native", "-fvisibility=default")  # of code for this processor alone
# The time of a compiler grows faster than a function that CasADi wrote. 366 kB took 5 s by -O3, 1.7 s by -O1, 0.4 s by
# -O0, and ran 6.9, 6.4 and 11.6 µs. 1.3 MB took above 100 s by -O3, 19 s by -O1, 1.3 s by -O0.
_LEVELS = ((100_000, "-O3"), (500_000, "-O1"))  # text of at most so many characters is compiled by this level
_SEAL = ".sha256"  # ends the name of the file beside cached machine code that holds its checksum
_CLOSE = "FreeLibrary" if os.name == "nt" else "dlclose"
_PROBE = 30.0  # a compiler has this long for a program of one line [s]
_COMPILING = 900.0  # and this long for any other [s]: the largest took 100 s on a quiet machine
_STEPS_A_THREAD = 50_000  # least steps for one thread: they take about 5 ms, and starting a thread takes 0.1 ms
_LOOP = """
#ifdef _WIN32
__declspec(dllexport)
#endif
void koopmpc_rollouts(long long episodes, long long steps, double* X, const double* U) {{
  const double* arg[{sz_arg}];
  double* res[{sz_res}];
  casadi_int iw[{sz_iw}];
  double w[{sz_w}];
  for (long long e = 0; e < episodes; ++e) {{
    for (long long k = 0; k < steps; ++k) {{
      arg[0] = X;
      arg[1] = U;
      res[0] = X + {nx};
      koopmpc_step(arg, res, iw, w, 0);
      X += {nx};
      U += {nu};
    }}
    X += {nx};
  }}
}}
"""


class Buffered(threading.local):
    """A CasADi function of float64 vectors at half a microsecond a call; a matrix result is flat, column after column.

    CasADi's FunctionBuffer reads and writes the arrays of this object, a set for each thread: fill `arguments`, call
    `evaluate`, and read `results` before the next call. Calling the object itself returns fresh copies.
    """

    def __init__(self, function: ca.Function) -> None:
        self.function = function
        self.arguments = tuple(np.zeros(function.size1_in(i)) for i in range(function.n_in()))
        self.results = tuple(np.zeros(function.nnz_out(i)) for i in range(function.n_out()))
        self.evaluate, self._buffer = bind_interpreter(function, self.arguments, self.results)
        if not function.is_a("SXFunction"):  # it may hold an integrator, and those swallow Ctrl-C
            self.evaluate = raise_swallowed()(self.evaluate)

    def __call__(self, *arguments: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return fresh results; `arguments` have the shapes of the function's inputs, (n,) each."""
        for place, value in zip(self.arguments, arguments, strict=True):
            place[:] = value
        self.evaluate()
        return tuple(result.copy() for result in self.results)

    def __reduce__(self) -> tuple[type["Buffered"], tuple[ca.Function]]:
        return Buffered, (self.function,)


@raise_swallowed()
def make_dense(function: ca.Function) -> ca.Function:
    """Return `function` with dense inputs and outputs; the buffer of a sparse function would hold only nonzeros."""
    sparsities = [function.sparsity_in(i) for i in range(function.n_in())]
    sparsities += [function.sparsity_out(i) for i in range(function.n_out())]
    if all(sparsity.is_dense() for sparsity in sparsities):
        return function
    arguments = [ca.MX.sym(function.name_in(i), *function.size_in(i)) for i in range(function.n_in())]
    results = [ca.densify(result) for result in function.call(arguments)]
    result = ca.Function(function.name(), arguments, results, function.name_in(), function.name_out())
    return result.expand() if function.is_a("SXFunction") else result


@raise_swallowed()
def _generate_rollouts(F: ca.Function) -> str:
    """Return C with ``koopmpc_rollouts(E, T, X, U)``: X (E, T+1, nx) from its first rows and U (E, T, nu)."""
    x, u = ca.SX.sym("x", F.size1_in(0)), ca.SX.sym("u", F.size1_in(1))
    step = ca.Function("koopmpc_step", [x, u], [F(x, u)])
    sizes = {f"sz_{name}": getattr(step, f"sz_{name}")() + 1 for name in ("arg", "res", "iw", "w")}
    return _generate_code(step) + _LOOP.format(nx=x.numel(), nu=u.numel(), **sizes)


@raise_swallowed()
def _generate_code(function: ca.Function) -> str:
    """Return CasADi's C with static functions: an exported name could clash with the same name in the process."""
    generator = ca.CodeGenerator("koopmpc", {"with_header": False})
    generator.add(function)
    return "#define CASADI_SYMBOL_EXPORT static\n" + generator.dump()


def find_compiler() -> list[str] | None:
    """Return the command of the first C compiler found among $CC, cc, gcc and clang; None where $CC cannot be read."""
    try:
        own = _read_words("CC")
    except OSError:
        return None
    for words in (own, ["cc"], ["gcc"], ["clang"]):
        if words and shutil.which(words[0]):
            return words
    return None


def _read_words(variable: str) -> list[str]:
    """Return the words of an environment variable; an OSError says that a quote has no end."""
    try:
        return shlex.split(os.environ.get(variable, ""))
    except ValueError as error:
        raise OSError(f"{variable} is {os.environ[variable]!r}, in which a quote has no end") from error


def try_compiler(command: list[str]) -> str:
    """Return why a C compiler does not make a library that loads, by a program of one line; empty where it does."""
    with tempfile.TemporaryDirectory() as folder:
        source, library = Path(folder) / "probe.c", Path(folder) / "probe.so"
        source.write_text("#include <math.h>\ndouble koopmpc_probe(double x) { return 2.0 * sqrt(x); }\n")
        words = [*command, "-O1", "-fPIC", "-shared", str(source), "-o", str(library), "-lm"]
        try:
            made = subprocess.run(words, capture_output=True, text=True, timeout=_PROBE, check=False)
            if made.returncode:
                said = (made.stderr or made.stdout).strip().splitlines()
                return f"{' '.join(command)} ended with {made.returncode}: {said[0] if said else 'it said nothing'}"
            probe = ctypes.CDLL(str(library)).koopmpc_probe
            probe.argtypes, probe.restype = [ctypes.c_double], ctypes.c_double
            return "" if probe(4.0) == 4.0 else f"{' '.join(command)} makes code that computes wrong numbers"
        except (OSError, subprocess.SubprocessError) as error:
            return f"{' '.join(command)} does not work: {error}"


def compile_kernel(F: ca.Function, command: list[str], cache: Path | None) -> Kernel:
    """Return F's machine code, loaded from `cache` or compiled into it; without a cache no file remains on disk.

    Raises
    ------
    OSError, subprocess.SubprocessError
        The compiler fails or its output does not load.
    """
    text = _generate_rollouts(F)
    rollouts = load_library(text, command, cache, choose_level(text)).koopmpc_rollouts
    rollouts.argtypes = [ctypes.c_longlong, ctypes.c_longlong, ctypes.c_void_p, ctypes.c_void_p]
    rollouts.restype = None

    def march(X: np.ndarray, U: np.ndarray) -> None:
        rollouts(U.shape[0], U.shape[1], X.ctypes.data, U.ctypes.data)

    def run(X: Float[np.ndarray, "E rows nx"], U: Float[np.ndarray, "E T nu"]) -> None:
        if not (X.flags.c_contiguous and U.flags.c_contiguous):
            raise AssertionError("machine code reads contiguous arrays only")
        episodes, steps = U.shape[:2]
        threads = min(os.cpu_count() or 1, episodes, episodes * steps // _STEPS_A_THREAD)
        if threads > 1:
            ends = [episodes * i // threads for i in range(threads + 1)]
            parts = [slice(*pair) for pair in pairwise(ends)]
            with ThreadPoolExecutor(threads) as pool:  # ctypes releases the interpreter's lock
                list(pool.map(march, [X[part] for part in parts], [U[part] for part in parts]))
        else:
            march(X, U)

    return run


def choose_level(text: str) -> str:
    """Return the level of optimisation for C that CasADi wrote, so that a compiler takes seconds and not minutes."""
    return next((level for most, level in _LEVELS if len(text) <= most), "-O0")


def open_library(path: Path) -> ctypes.CDLL:
    """Return the library of this file, which leaves the process with the last reference to it or to its functions."""
    code = ctypes.CDLL(str(path))
    weakref.finalize(code, getattr(_ctypes, _CLOSE), code._handle).atexit = False
    return code


def load_library(
    text: str, command: list[str], cache: Path | None, level: str = "-O3", *, native: bool = False
) -> ctypes.CDLL:
    """Return the machine code of this C, loaded from `cache` or compiled into it; without a cache no file remains.

    The flags in the environment variable KOOPMPC_CFLAGS follow the library's own flags. The name of a cached file
    depends on the text, the flags, the processor and the compiler, so that machines that share a home share no code
    that another one cannot run. With `native` the code is for this processor, if the compiler knows its flags.

    Raises
    ------
    OSError, subprocess.SubprocessError
        The compiler fails or its output does not load.
    """
    flags = [level, *_FLAGS, *_read_words("KOOPMPC_CFLAGS")]
    if native and platform.machine() in ("x86_64", "AMD64"):
        with suppress(subprocess.CalledProcessError):  # the compiler does not know this processor
            return _load(text, [*command, *_NATIVE, *flags], cache)
    return _load(text, [*command, *flags], cache)


def _load(text: str, words: list[str], cache: Path | None) -> ctypes.CDLL:
    """Return the machine code of this C by these words of a command, from `cache` where it is there."""
    if cache is None:
        with tempfile.TemporaryDirectory() as folder:  # loaded code stays valid when its file is gone
            return open_library(_compile(text, words, Path(folder) / "step.so"))
    key = "\0".join([text, *words, _describe_host(), _describe_compiler(tuple(words))])
    path = cache / f"{fingerprint(key.encode())}.so"
    if _is_whole(path):
        try:
            return open_library(path)
        except OSError:  # another kind of machine wrote the file: compile again
            path.unlink()
    return open_library(_compile(text, words, path))


@remember
def _describe_host() -> str:
    """Return the system, its C library, and the flags of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    processor = next((line for line in lines if line.startswith("flags")), platform.processor())
    return " ".join((platform.system(), platform.machine(), *platform.libc_ver(), processor))


@remember
def _describe_compiler(words: tuple[str, ...]) -> str:
    """Return the file of a compiler and the version that it prints."""
    with suppress(OSError, subprocess.SubprocessError):
        printed = subprocess.run([*words, "--version"], capture_output=True, timeout=_COMPILING, check=False).stdout
        return f"{shutil.which(words[0])} {printed.decode(errors='replace')}"
    return words[0]


def _is_whole(library: Path) -> bool:
    """Return whether a cached file is, to the bit, what was compiled; a damaged one could end the process."""
    try:
        return library.with_suffix(_SEAL).read_text() == fingerprint(library.read_bytes())
    except (OSError, UnicodeDecodeError):
        return False


def find_private_cache() -> Path | None:
    """Return this user's folder for machine code, or None if other users could write into it."""
    if not hasattr(os, "getuid"):
        return None
    base = os.environ.get("XDG_CACHE_HOME", "")
    folder = (Path(base) if Path(base).is_absolute() else Path.home() / ".cache") / "koopmpc"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        ours = _is_private(folder) and os.access(folder, os.W_OK)
    except OSError:
        return None
    return folder if ours else None


def _is_private(folder: Path) -> bool:
    """Return True if only this user and root can write into `folder` or change its path."""
    status = folder.lstat()
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & 0o022:
        return False
    above = [parent.stat() for parent in folder.resolve().parents]
    return all(
        parent.st_uid in (0, os.getuid()) and (not parent.st_mode & 0o022 or parent.st_mode & stat.S_ISVTX)
        for parent in above
    )


def _compile(text: str, words: list[str], path: Path) -> Path:
    """Compile in a temporary folder beside `path`, move the file to `path` in one step, and write its checksum."""
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        library = build_library(text, words, Path(folder))
        seal = fingerprint(library.read_bytes())
        library.replace(path)
        with suppress(OSError):  # code without a checksum is compiled again
            path.with_suffix(_SEAL).write_text(seal)
    return path


def build_library(text: str, words: list[str], folder: Path) -> Path:
    """Compile this C into a library in `folder`, by these words of a command.

    Raises
    ------
    OSError, subprocess.SubprocessError
        The compiler fails.
    """
    code, library = folder / "step.c", folder / "step.so"
    code.write_text(text, encoding="utf-8")
    command = [*words, "-o", str(library), str(code), "-lm"]
    subprocess.run(command, check=True, capture_output=True, timeout=_COMPILING)
    return library


_CALL = """
#ifdef _WIN32
__declspec(dllexport)
#endif
int koopmpc_call(const double** arg, double** res, casadi_int* iw, double* w) {
  return %s(arg, res, iw, w, 0);
}
"""


class Routine:
    """A CasADi function that reads `arguments` and writes `results`, float64 arrays with matrices column by column.

    Machine code and the interpreter give the same numbers. Implicit integrators always run in the interpreter; with
    `compiles` False every function does.
    """

    def __init__(
        self,
        function: ca.Function,
        arguments: Sequence[np.ndarray],
        results: Sequence[np.ndarray],
        *,
        compiles: bool = True,
    ) -> None:
        sizes = [function.nnz_in(i) for i in range(function.n_in())]
        sizes += [function.nnz_out(i) for i in range(function.n_out())]
        for size, array in zip(sizes, [*arguments, *results], strict=True):
            assert array.dtype == np.float64, "machine code reads float64"
            assert array.flags.c_contiguous, "machine code reads contiguous arrays"
            assert array.size == size, f"an array has {array.size} entries, the function {size}"
        self._kept: list[Any] = [*arguments, *results]  # keeps the arrays alive: both routes hold only pointers to them
        call = _bind_machine_code(function, arguments, results, self._kept) if compiles else None
        self.compiled = call is not None
        if call is None:
            call, buffer = bind_interpreter(function, arguments, results)
            self._kept.append(buffer)
        self.call: Callable[[], object] = call


def _bind_machine_code(
    function: ca.Function, arguments: Sequence[np.ndarray], results: Sequence[np.ndarray], kept: list[Any]
) -> Callable[[], object] | None:
    command = find_compiler()
    if command is None:
        return None
    try:
        text = _generate_code(function) + _CALL % function.name()
        code = load_library(text, command, find_private_cache(), choose_level(text))
    except (OSError, RuntimeError, subprocess.SubprocessError):
        return None
    call = code.koopmpc_call
    arg = (ctypes.c_void_p * (function.sz_arg() + 1))(*(a.ctypes.data for a in arguments))
    res = (ctypes.c_void_p * (function.sz_res() + 1))(*(r.ctypes.data for r in results))
    w = np.zeros(function.sz_w() + 1)
    iw = np.zeros(function.sz_iw() + 1, dtype=np.int64)
    kept += [code, arg, res, iw, w]
    pointers = [ctypes.c_void_p(ctypes.addressof(each)) for each in (arg, res)]
    pointers += [ctypes.c_void_p(each.ctypes.data) for each in (iw, w)]
    return lambda: call(*pointers)


def bind_interpreter(
    function: ca.Function, arguments: Sequence[np.ndarray], results: Sequence[np.ndarray]
) -> tuple[Callable[[], None], Any]:
    """Return a call that evaluates `function` on these arrays, and its buffer.

    The caller must keep the arrays and the buffer alive, because CasADi holds no reference to them.
    """
    buffer, evaluate = cast("tuple[Any, Callable[[], None]]", function.buffer())
    for i, array in enumerate(arguments):
        if array.size:
            buffer.set_arg(i, array.data)
    for i, array in enumerate(results):
        if array.size:
            buffer.set_res(i, array.data)
    return evaluate, buffer
