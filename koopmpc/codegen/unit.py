"""A controller as a Functional Mock-up Unit: its C in one file, its description, and machine code for this platform."""

import os
import platform
import re
import shlex
import subprocess
import sys
import tempfile
import warnings
import zipfile
from pathlib import Path
from typing import Literal, NamedTuple
from xml.sax.saxutils import quoteattr

from koopmpc.base.disk import writing
from koopmpc.base.errors import SourcesOnlyWarning
from koopmpc.base.values import fingerprint
from koopmpc.codegen.sources import join_sources, read_shipped, rename_symbols
from koopmpc.codegen.tables import Tables
from koopmpc.plants.routines import build_library, find_compiler

FMIVersion = Literal[2, 3]

_FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fPIC", "-shared", "-fvisibility=hidden")
_ENDINGS = {"linux": ".so", "darwin": ".dylib"}
_DAY = (1980, 1, 1, 0, 0, 0)  # date of the files in the archive, so that one controller gives one file
_ORDER = (
    "Sampled: one step is one sample. doStep takes y and the reference of now and gives u for the sample that begins, "
    "so step the controller before the plant."
)
_STATUS = (
    "0 unconstrained, 1 optimal, 2 softened, 3 saturated, 4 iteration limit, 6 infeasible, 7 bad measurement, 8 failed"
)
_FALLBACK = "0 none, 1 shifted plan, 2 clipped LQR, 3 hold"


class _Real(NamedTuple):
    """A real variable of the unit: its name, causality, unit and description."""

    name: str
    cause: Literal["input", "parameter", "output"]
    unit: str
    what: str


def write_unit(tables: Tables, texts: dict[str, str], path: Path, name: str, version: FMIVersion) -> None:
    """Write the unit: description, one C file, licence, and machine code if there is a compiler.

    Parameters
    ----------
    tables, texts
        The controller's numbers and the text of its C files, before they get their prefix.
    path
        The .fmu file.
    name
        Prefix of the symbols, and the unit's name.
    version
        2 or 3, of the standard.

    Warns
    -----
    SourcesOnlyWarning
        There is no C compiler, or it failed: the unit holds sources only.

    References
    ----------
    Functional Mock-up Interface Specification 2.0.4 and 3.0.1, Modelica Association.
    """
    code = join_sources(texts)
    parts = [code, read_shipped("c", "unit.c"), read_shipped("c", f"fmi{version}.c")]
    token = fingerprint("".join(parts).encode())[:32]
    parts.insert(1, f'#define KOOPMPC_TOKEN "{token}"\n#define FMI(name) fmi{version}##name\n')
    source = rename_symbols({"all": "\n".join(parts)}, name)["all"]
    files = {"modelDescription.xml": _describe(tables, name, token, version).encode()}
    files[f"sources/{name}.c"] = source.encode()
    if version == 3:
        files["sources/buildDescription.xml"] = _BUILD.format(name=name).encode()
    if "daqp/LICENSE" in texts:
        files["documentation/licenses/daqp.txt"] = texts["daqp/LICENSE"].encode()
    binary = _compile(source)
    if binary is not None:
        ending = _ENDINGS.get(sys.platform, ".so")
        files[f"binaries/{_platform_folder(version)}/{name}{ending}"] = binary
    with writing(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for inside, content in files.items():
            archive.writestr(zipfile.ZipInfo(inside, _DAY), content, zipfile.ZIP_DEFLATED)


def _platform_folder(version: FMIVersion) -> str:
    """Return the folder of this platform's machine code, by the names of the standard."""
    system = {"linux": "linux", "darwin": "darwin"}.get(sys.platform, sys.platform)
    return f"{system}64" if version == 2 else f"{platform.machine()}-{system}"


def _compile(source: str) -> bytes | None:
    """Return the machine code of this C for this platform; None without a compiler."""
    command, reason = find_compiler(), "no C compiler was found ($CC, cc, gcc, clang)"
    if command is not None:
        with tempfile.TemporaryDirectory() as folder:
            try:
                flags = [*_FLAGS, *shlex.split(os.environ.get("KOOPMPC_CFLAGS", ""))]
                return build_library(source, [*command, *flags], Path(folder)).read_bytes()
            except (OSError, subprocess.SubprocessError) as error:
                reason = f"{command[0]} failed: {error}"
    warnings.warn(f"{reason}; the unit holds C sources only", SourcesOnlyWarning, stacklevel=4)
    return None


def _list_reals(tables: Tables) -> list[_Real]:
    """Return the real variables in the order of their value references: inputs, x0, outputs."""
    sizes, model = tables.sizes, tables.program.model
    groups: list[tuple[str, Literal["input", "parameter", "output"], int, tuple[str, ...], str]] = [
        ("y", "input", sizes["NY"], model.states, "measured"),
        ("reference", "input", sizes["NR"], model.states, "reference of"),
        ("w", "input", sizes["NW"], getattr(model, "disturbances", ()), "measured disturbance"),
        ("x0", "parameter", sizes["NX"], model.states, "start of the estimator:"),
        ("u", "output", sizes["NU"], model.inputs, "input of the plant:"),
    ]
    result: list[_Real] = []
    for group, cause, count, labels, what in groups:
        names = labels if len(labels) == count else tuple(f"{group}{i + 1}" for i in range(count))
        used: set[str] = set()
        for i, label in enumerate(names):
            text, _, unit = label.partition(" [")
            short = re.sub(r"\W", "_", text, flags=re.ASCII)
            short = short if short[:1].isalpha() and short not in used else f"{group}{i + 1}"
            used.add(short)
            result.append(_Real(f"{group}.{short}", cause, unit.rstrip("]"), f"{what} {label}"))
    return result


_BUILD = """<?xml version="1.0" encoding="UTF-8"?>
<fmiBuildDescription fmiVersion="3.0">
  <BuildConfiguration modelIdentifier="{name}">
    <SourceFileSet language="C99"><SourceFile name="{name}.c"/></SourceFileSet>
  </BuildConfiguration>
</fmiBuildDescription>
"""


_WHOLE = (("status", _STATUS), ("fallback", _FALLBACK), ("iterations", "iterations of the QP solver"))


def _list_variables(reals: list[_Real], version: FMIVersion) -> list[str]:
    """Return the elements of all variables; those of FMI 3 have time among them."""
    rows: list[str] = []
    for i, each in enumerate([*reals, *(_Real(word, "output", "", what) for word, what in _WHOLE)]):
        kind, exact = "fixed" if each.cause == "parameter" else "discrete", each.cause != "input"
        about = f'name="{each.name}" valueReference="{i}" causality="{each.cause}" variability="{kind}"'
        about += (' initial="exact"' if exact else "") + f" description={quoteattr(each.what)}"
        value = 'start="0"' + (f" unit={quoteattr(each.unit)}" if each.unit else "")
        if version == 3:
            rows.append(f"    <{'Float64' if i < len(reals) else 'Int32'} {about} {value}/>")
        else:
            tag = "Real" if i < len(reals) else "Integer"
            rows.append(f"    <ScalarVariable {about}><{tag} {value}/></ScalarVariable>")
    if version == 3:
        time = (
            f'    <Float64 name="time" valueReference="{len(rows)}" causality="independent" variability="continuous"/>'
        )
        rows.append(time)
    return rows


def _describe(tables: Tables, name: str, token: str, version: FMIVersion) -> str:
    """Return modelDescription.xml."""
    reals, dt = _list_reals(tables), repr(float(tables.program.dt))
    units = sorted({each.unit for each in reals if each.unit})
    outputs = [i for i, each in enumerate(reals) if each.cause == "output"]
    outputs += range(len(reals), len(reals) + len(_WHOLE))
    definitions = "".join(f"<Unit name={quoteattr(unit)}/>" for unit in units)
    definitions = f"  <UnitDefinitions>{definitions}</UnitDefinitions>\n" if units else ""
    experiment = f'  <DefaultExperiment startTime="0" stepSize="{dt}"/>\n'
    head = f"modelName={quoteattr(name)} description={quoteattr(tables.program.controller + ' of koopmpc. ' + _ORDER)}"
    head += ' generationTool="koopmpc" variableNamingConvention="structured"'
    structure = "".join(f'<Output valueReference="{i}"/>' for i in outputs)
    opening = f'fmiVersion="3.0" instantiationToken="{token}"'
    interface = (
        f'  <CoSimulation modelIdentifier="{name}" canHandleVariableCommunicationStepSize="false" '
        f'fixedInternalStepSize="{dt}"/>\n'
    )
    if version == 2:
        structure = "".join(f'<Unknown index="{i + 1}"/>' for i in outputs)
        structure = f"<Outputs>{structure}</Outputs>"
        opening = f'fmiVersion="2.0" guid="{token}"'
        interface = (
            f'  <CoSimulation modelIdentifier="{name}" canHandleVariableCommunicationStepSize="false">\n'
            f'    <SourceFiles><File name="{name}.c"/></SourceFiles>\n  </CoSimulation>\n'
        )
    variables = "\n".join(_list_variables(reals, version))
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<fmiModelDescription {opening} {head}>\n{interface}{definitions}'
        f"{experiment}  <ModelVariables>\n{variables}\n  </ModelVariables>\n"
        f"  <ModelStructure>{structure}</ModelStructure>\n</fmiModelDescription>\n"
    )
