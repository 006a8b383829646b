"""An FMU of the tests' wheel, in C: pull from slip and load, and a rut that deepens with time."""

from __future__ import annotations

import shutil
import subprocess
import zipfile
from pathlib import Path

import fmpy

VARIABLES = (
    ("mu", "parameter", "fixed", ' start="0.5"'),
    ("tyre.s0", "parameter", "fixed", ' start="0.1"'),
    ("z0", "parameter", "fixed", ' start="10"'),
    ("tau", "parameter", "fixed", ' start="1"'),
    ("slip", "input", "continuous", ' start="0"'),
    ("load", "input", "continuous", ' start="5" unit="kN"'),
    ("pull", "output", "continuous", ' unit="N"'),
    ("rut", "output", "continuous", ""),
)
# An FMU that keeps instances fails after a thousand, one whose mu is 7 hangs, one whose mu is 8
# ends before it is asked to.
SOURCE = r"""
#include <math.h>
#include <stdlib.h>
#include <unistd.h>
static double v[8], t;
static int made;
const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }
void *fmi2Instantiate(const char *n, int k, const char *g, const char *r, const void *f, int w,
                      int l)
{ return ++made > 1000 ? NULL : v; }
void fmi2FreeInstance(void *c) {}
int fmi2SetDebugLogging(void *c, int on, size_t n, const char *const what[]) { return 0; }
int fmi2SetupExperiment(void *c, int d, double e, double start, int s, double stop)
{ t = start; return 0; }
int fmi2EnterInitializationMode(void *c) { return 0; }
int fmi2ExitInitializationMode(void *c) { return 0; }
int fmi2Terminate(void *c) { return 0; }
int fmi2SetReal(void *c, const unsigned r[], size_t n, const double x[])
{ for (size_t i = 0; i < n; ++i) v[r[i]] = x[i]; return 0; }
int fmi2GetReal(void *c, const unsigned r[], size_t n, double x[])
{
    v[6] = 1000 * v[5] * v[0] * (1 - exp(-v[4] / v[1]));
    v[7] = v[2] * v[5] * (1 - exp(-t / v[3]));
    for (size_t i = 0; i < n; ++i) x[i] = v[r[i]];
    return 0;
}
int fmi2GetBooleanStatus(void *c, int s, int *b) { *b = 1; return 0; }
int fmi2GetRealStatus(void *c, int s, double *x) { *x = t; return 0; }
int fmi2DoStep(void *c, double now, double h, int keep)
{
    while (v[0] == 7) sleep(1);
    if (v[0] == 8) return 2;
    t = now + h;
    return 0;
}
"""
# What FMPy looks for and this FMU does not have.
MISSING = (
    "CancelStep DeSerializeFMUstate FreeFMUstate GetBoolean GetDirectionalDerivative GetFMUstate "
    "GetInteger GetIntegerStatus GetRealOutputDerivatives GetStatus GetString GetStringStatus "
    "Reset SerializeFMUstate SerializedFMUstateSize SetBoolean SetFMUstate SetInteger "
    "SetRealInputDerivatives SetString"
)
DESCRIPTION = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="wheel" guid="{{1}}">
<CoSimulation modelIdentifier="wheel" canHandleVariableCommunicationStepSize="true"/>
<UnitDefinitions><Unit name="kN"/><Unit name="N"/></UnitDefinitions>
{ends}<ModelVariables>
{variables}
</ModelVariables>
<ModelStructure><Outputs><Unknown index="7"/><Unknown index="8"/></Outputs></ModelStructure>
</fmiModelDescription>
"""


def build(folder: Path, *, ends: bool = True) -> Path:
    """Compile the FMU with gcc and return its path."""
    variables = "\n".join(
        f'<ScalarVariable name="{name}" valueReference="{i}" causality="{causality}" '
        f'variability="{variability}"><Real{said}/></ScalarVariable>'
        for i, (name, causality, variability, said) in enumerate(VARIABLES)
    )
    source, library = folder / "wheel.c", folder / f"wheel{fmpy.sharedLibraryExtension}"
    missing = "\n".join(f"int fmi2{name}(void) {{ return 3; }}" for name in MISSING.split())
    source.write_text(SOURCE + missing)
    gcc = shutil.which("gcc") or "gcc"
    subprocess.run([gcc, "-shared", "-fPIC", str(source), "-o", str(library), "-lm"], check=True)
    with zipfile.ZipFile(folder / "wheel.fmu", "w") as fmu:
        end = '<DefaultExperiment startTime="0" stopTime="2" stepSize="0.5"/>\n' if ends else ""
        fmu.writestr("modelDescription.xml", DESCRIPTION.format(ends=end, variables=variables))
        fmu.write(library, f"binaries/{fmpy.platform}/{library.name}")
    return folder / "wheel.fmu"
