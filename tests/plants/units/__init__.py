"""Functional Mock-up Units that the tests make: FMI 2 and 3, model exchange and co-simulation."""

import contextlib
import io
import os
import subprocess
import zipfile
from pathlib import Path

import casadi as ca

from tests.compiler import find_compiler

HERE = Path(__file__).parent
DESCRIPTION = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="Pendulum" guid="{{1}}"{events}>
  <ModelExchange modelIdentifier="pendulum" providesDirectionalDerivative="{slopes}"/>
  <CoSimulation modelIdentifier="pendulum" canHandleVariableCommunicationStepSize="true"/>
  <UnitDefinitions>
    <Unit name="rad"/><Unit name="rad/s"/><Unit name="N.m"/><Unit name="m/s2"/>
  </UnitDefinitions>
  <TypeDefinitions>
    <SimpleType name="Angle"><Real unit="rad" min="-4" max="4"/></SimpleType>
  </TypeDefinitions>
  <DefaultExperiment stepSize="0.05"/>
  <ModelVariables>
    <ScalarVariable name="theta" valueReference="0" causality="output" initial="exact">
      <Real start="0.3" declaredType="Angle"/></ScalarVariable>
    <ScalarVariable name="omega" valueReference="1" initial="exact"><Real start="0" unit="rad/s"/></ScalarVariable>
    <ScalarVariable name="der(theta)" valueReference="1"><Real derivative="1"/></ScalarVariable>
    <ScalarVariable name="der(omega)" valueReference="2"><Real derivative="2"/></ScalarVariable>
    <ScalarVariable name="tau" valueReference="3" causality="input">
      <Real start="0" min="-5" max="5" unit="N.m"/></ScalarVariable>
    <ScalarVariable name="g" valueReference="4" causality="parameter" variability="fixed">
      <Real start="9.81" unit="m/s2"/></ScalarVariable>
    <ScalarVariable name="reach" valueReference="5" causality="{reach}"><Real/></ScalarVariable>
  </ModelVariables>
  <ModelStructure>
    <Outputs><Unknown index="1"/>{outputs}</Outputs>
    <Derivatives><Unknown index="3"/><Unknown index="4"/></Derivatives>
    <InitialUnknowns>{outputs}<Unknown index="3"/><Unknown index="4"/></InitialUnknowns>
  </ModelStructure>
</fmiModelDescription>
"""


def headers() -> str:
    """Return the folder of FMI's C headers, which FMPy brings along."""
    import fmpy

    return str(Path(fmpy.__file__).parent / "c-code")


def build_pendulum(
    path: Path,
    *,
    events: int = 0,
    driven: bool = False,
    direct: bool = False,
    slopes: bool = False,
    folder: str = "linux64",
) -> Path:
    """Write the FMI 2 unit of pendulum.c, for model exchange and co-simulation."""
    library = path.with_suffix(".so")
    flags = ["-O1", "-shared", "-fPIC", f"-I{headers()}", *(["-DDRIVEN"] if driven else [])]
    subprocess.run(
        [*(find_compiler() or ["cc"]), *flags, str(HERE / "pendulum.c"), "-o", str(library), "-lm"], check=True
    )
    text = DESCRIPTION.format(
        events=f' numberOfEventIndicators="{events}"' if events else "",
        slopes="true" if slopes else "false",
        reach="output" if direct else "local",
        outputs='<Unknown index="7"/>' if direct else "",
    )
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", text)
        archive.write(library, f"binaries/{folder}/pendulum.so")
    return path


def build_pendulum3(folder: Path) -> Path:
    """Write the same pendulum as the FMI 3 model exchange unit that CasADi makes."""
    builder = ca.DaeBuilder("pendulum3")
    theta, omega = builder.add("theta", {"unit": "rad"}), builder.add("omega", {"unit": "rad/s"})
    tau = builder.add("tau", "input", {"unit": "N.m", "min": -5.0, "max": 5.0})
    g = builder.add("g", "parameter", "tunable", {"start": 9.81})
    builder.eq(builder.der(theta), omega)
    builder.eq(builder.der(omega), -g * ca.sin(theta) - 0.1 * omega + tau)
    with contextlib.chdir(folder):
        files = builder.export_fmu({"no_warning": True, "with_serialization": False})
        name = builder.pack_fmu(builder.compile_fmu(files, {"include_dirs": [headers()]}), {})
    return folder / name


def build_tank(folder: Path, fmi: int) -> Path:
    """Write the tank as a co-simulation unit by pythonfmu or pythonfmu3."""
    name = "tank.py" if fmi == 2 else "tank3.py"
    with contextlib.redirect_stdout(io.StringIO()):
        if fmi == 2:
            from pythonfmu import FmuBuilder
        else:
            from pythonfmu3 import FmuBuilder
        found = FmuBuilder.build_FMU(str(HERE / name), dest=str(folder))
    return Path(os.fspath(found))
