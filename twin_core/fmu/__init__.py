"""A calibrated model as a functional mock-up unit (FMI 3.0): generated C around a small runtime, no Python inside."""

import json
import platform
import shutil
import subprocess
import tempfile
import uuid
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import quoteattr

from twin_core import __version__
from twin_core._typing import Json
from twin_core.calibrate.result import CalibratedModel
from twin_core.constants import ZERO_CELSIUS_K
from twin_core.errors import ModelError
from twin_core.fmu.terms import Names, boundary_changes, extra_capacities, formula, heats, reading_offsets
from twin_core.network.formula import channels_of, is_dated
from twin_core.network.model import Network
from twin_core.network.thermostat import UNSETTLED, ThermostatHeat
from twin_core.units import parse_instant_ns

RUNTIME = Path(__file__).parent / "c"
EPOCH = "epoch_unix_s"
"""The parameter that dates time 0, where the model depends on the date."""
START_K = 293.15
COMPILERS = ("cc", "gcc", "clang")
_HELPERS = """
static double fourth(double x) { return x * x * x * x; }

static double ramp(double clock, double onset, double width) {
    return fmin(fmax((clock - onset) / width + 0.5, 0.0), 1.0);
}

/* A straight line that bends into a hyperbola below its least share, and stays positive. */
static double bent(double line, double least) { return line < least ? least / (2.0 - line / least) : line; }

static double bell(double x, double width) { return exp(-0.5 * x * x / (width * width)) / (width * 2.5066282746310002); }

static double convection(double k, double power, double d, double rounding) {
    return k * d * exp(0.5 * (power - 1.0) * log(d * d + rounding * rounding));
}

static double nearest(double x, int n, const double *knots, const double *values) {
    int best = 0;
    for (int i = 1; i < n; i++)
        if (fabs(x - knots[i]) < fabs(x - knots[best])) best = i;
    return values[best];
}

static double linear(double x, int n, const double *knots, const double *values) {
    if (n == 1 || x <= knots[0]) return values[0];
    for (int i = 1; i < n; i++)
        if (x < knots[i]) return values[i - 1] + (values[i] - values[i - 1]) * (x - knots[i - 1]) / (knots[i] - knots[i - 1]);
    return values[n - 1];
}

/* (1 AU / distance of the Sun) squared: low-precision formula of the Astronomical Almanac, section C. */
static double sun_factor(double unix_s) {
    double g = (357.528 + 0.9856003 * (unix_s - 946728000.0) / 86400.0) * 0.017453292519943295;
    double r = 1.00014 - 0.01671 * cos(g) - 0.00014 * cos(2.0 * g);
    return 1.0 / (r * r);
}
"""


@dataclass(frozen=True)
class Variable:
    """One variable of the unit; its value reference is its position among all."""

    name: str
    attributes: str
    unit: str = ""


@dataclass(frozen=True)
class _Plan:
    """What the unit has: names of states, inputs from outside, outputs, parameters with their values."""

    model: CalibratedModel
    network: Network
    inputs: tuple[str, ...]
    epoch_s: float | None

    @property
    def names(self) -> Names:
        """Positions in the generated C."""
        everything = (*self.inputs, *self.model.spec.derived)
        positions = {name: i for i, name in enumerate(everything)}
        return Names(positions, {name: i for i, name in enumerate(self.parameters)})

    @property
    def parameters(self) -> dict[str, float]:
        """Name -> value, the date of time 0 included where it matters."""
        own = self.network.parameters.as_dict()
        return own if self.epoch_s is None else own | {EPOCH: self.epoch_s}

    @property
    def relays(self) -> tuple[ThermostatHeat, ...]:
        """Thermostats, in the order of the network's terms."""
        return tuple(term for term in self.network.terms if isinstance(term, ThermostatHeat))


def _plan(model: CalibratedModel) -> _Plan:
    """Return what a model's unit holds; ModelError where part of it has no form in C."""
    network, spec = model.network(), model.spec
    wanted = {load.channel for load in spec.loads} | {load.factor for load in spec.loads if load.factor is not None}
    wanted |= {b.channel for b in spec.boundaries.values() if b.channel is not None}
    wanted |= {str(effect.where["channel"]) for effect in model.effects if "channel" in effect.where}
    for name in reversed(spec.derived):
        if name in wanted:
            wanted |= set(channels_of(spec.derived[name].formula))
    known = [*spec.channels, *spec.orbit_channels]
    inputs = tuple(name for name in known if name in wanted)
    dated = network.dated is True or any(load.solar for load in spec.loads)
    dated = dated or any(is_dated(derived.formula) for derived in spec.derived.values())
    start = model.summary.get("train", {}).get("start")
    epoch_s = None
    if dated:
        epoch_s = parse_instant_ns(start) / 1e9 if isinstance(start, str) else 0.0
    return _Plan(model, network, inputs, epoch_s)


def c_source(model: CalibratedModel) -> dict[str, str]:
    """Return file name -> text of the C of a model's own heat balance.

    Raises
    ------
    ModelError
        Naming what of the model has no form in C.
    """
    plan = _plan(model)
    network, spec, names = plan.network, model.spec, plan.names
    parameters, relays = plan.parameters, plan.relays
    n, unit_of = len(network.nodes), _units(model)
    clock = "time" if plan.epoch_s is None else f"time + p[{names.parameters[EPOCH]}]"
    body = [f"    double clock = {clock}, sun = sun_factor(clock), q = 0.0;", "    (void)sun, (void)q;"]
    body += ["    double B[N_BOUNDARIES + 1], Q[N_STATES] = {0}, u[N_CHANNELS + 1];"]
    body += ["    for (int i = 0; i < N_INPUTS; i++) u[i] = inputs[i];"]
    body += [
        f"    {names.u(name)} = {formula(d.formula, names)};"
        for name, d in spec.derived.items()
        if _reachable(d.formula, names)
    ]
    body += [f"    {line}" for line in _boundaries(model, names)]
    body += [f"    {line}" for line in boundary_changes(network, names)]
    body += [f"    {line}" for line in heats(network, model.effects, names)]
    index = network.capacity_index
    ordered = list(network.parameters.index)
    more = extra_capacities(network, names)
    own = [f"p[{names.parameters[ordered[int(k)]]}]" for k in index]
    body += [f"    rates[{i}] = Q[{i}] / ({own[i]}{more.get(i, '')});" for i in range(n)]
    offsets = reading_offsets(network, names)
    outputs = [f"    double clock = {clock};", "    (void)clock;"]
    for i, (sensor, node) in enumerate(zip(spec.sensors, network.sensor_node.tolist(), strict=True)):
        shift = f" - {ZERO_CELSIUS_K}" if unit_of[sensor] == "degC" else ""
        outputs.append(f"    outputs[{i}] = T[{node}]{offsets.get(i, '')}{shift};")
    text = [
        f"/* The heat balance of {spec.twin}, written by thermal-twin {__version__}. */",
        '#include "network.h"',
        "#include <math.h>",
        _HELPERS,
        _array("network_start", [START_K] * n),
        _array("network_inputs", [_rest(spec.channels[c].unit) if c in spec.channels else 0.0 for c in plan.inputs]),
        _array("network_parameters", list(parameters.values())),
        f"const Relay network_relays[] = {{{', '.join([_relay(relay, names) for relay in relays] + ['{0}'])}}};",
        "",
        "void network_rates(double time, const double *T, const double *inputs, const double *p, const double *share,"
        " double *rates) {",
        *body,
        "}",
        "",
        "void network_outputs(double time, const double *T, const double *p, double *outputs) {",
        *outputs,
        "}",
    ]
    return {"network.h": _header(plan), "network.c": "\n".join(text) + "\n"}


def _header(plan: _Plan) -> str:
    """Return the text of the header: how many there are of what, and what the solver calls."""
    spec = plan.model.spec
    counts = {
        "N_STATES": len(plan.network.nodes),
        "N_INPUTS": len(plan.inputs),
        "N_OUTPUTS": len(spec.sensors),
        "N_PARAMETERS": len(plan.parameters),
        "N_BOUNDARIES": len(spec.boundaries),
        "N_CHANNELS": len(plan.names.inputs),
        "N_RELAYS": len(plan.relays),
    }
    lines = [
        f'#define TOKEN "{_token(plan.model)}"',
        f"enum {{ {', '.join(f'{name} = {count}' for name, count in counts.items())} }};",
        f"#define UNSETTLED {UNSETTLED!r}",
        "/* Of a thermostat: states of its node and its memory, thresholds among the parameters, what the memory is. */",
        "typedef struct { int node, memory, on, off; double on_K, off_K; } Relay;",
        "extern const Relay network_relays[];",
        "extern const double network_start[], network_inputs[], network_parameters[];",
        "void network_rates(double time, const double *T, const double *inputs, const double *p, const double *share,"
        " double *rates);",
        "void network_outputs(double time, const double *T, const double *p, double *outputs);",
    ]
    return "\n".join(lines) + "\n"


def _units(model: CalibratedModel) -> dict[str, str | None]:
    return {name: channel.unit for name, channel in model.spec.channels.items()}


def _boundaries(model: CalibratedModel, names: Names) -> Iterator[str]:
    """Yield what sets the boundaries' temperatures in K: a channel, a known value, or a parameter."""
    units = _units(model)
    for i, (name, boundary) in enumerate(model.spec.boundaries.items()):
        if boundary.channel is not None:
            shift = f" + {ZERO_CELSIUS_K}" if units[boundary.channel] == "degC" else ""
            yield f"B[{i}] = {names.u(boundary.channel)}{shift};"
        elif boundary.value_K is not None:
            yield f"B[{i}] = {boundary.value_K!r};"
        else:
            yield f"B[{i}] = p[{names.parameters[f'T:{name}']}];"


def _relay(relay: ThermostatHeat, names: Names) -> str:
    on, off = (names.parameters[parameter.name] for parameter in relay.parameters[1:])
    memory = relay.memory
    return f"{{{relay.node}, {relay.state}, {on}, {off}, {memory.on_K!r}, {memory.off_K!r}}}"


def _reachable(text: str, names: Names) -> bool:
    return all(name in names.inputs for name in channels_of(text))


def _rest(unit: str | None) -> float:
    """Return where an input begins: a temperature at room temperature, anything else at nothing."""
    return {"K": START_K, "degC": START_K - ZERO_CELSIUS_K}.get(unit or "", 0.0)


def _array(name: str, values: list[float]) -> str:
    return f"const double {name}[] = {{{', '.join(map(repr, [*map(float, values), 0.0]))}}};"


def _token(model: CalibratedModel) -> str:
    """Return what tells this unit from any other: of the same model always the same."""
    return str(uuid.uuid5(uuid.NAMESPACE_OID, json.dumps(model.to_json(), sort_keys=True, default=str)))


def variables(model: CalibratedModel) -> list[Variable]:
    """Return the variables of a model's unit, in the order of their value references."""
    plan = _plan(model)
    network, spec = plan.network, model.spec
    n = len(network.nodes)
    told = [Variable("time", 'causality="independent"', "s")]
    state = f'causality="local" variability="continuous" initial="exact" start="{START_K!r}"'
    told += [Variable(f"node.{name}", state, "K") for name in network.nodes]
    rate = 'causality="local" variability="continuous" initial="calculated" derivative="{}"'
    told += [Variable(f"der(node.{name})", rate.format(1 + i), "K/s") for i, name in enumerate(network.nodes)]
    for name in plan.inputs:
        channel = spec.channels.get(name)
        unit = "W/m2" if channel is None else channel.unit or ""
        start = _rest(None if channel is None else channel.unit)
        told.append(Variable(name, f'causality="input" variability="continuous" start="{start!r}"', unit))
    for sensor in spec.sensors:
        told.append(
            Variable(
                sensor,
                'causality="output" variability="continuous" initial="calculated"',
                spec.channels[sensor].unit or "",
            )
        )
    units = {p.name: p.unit for p in network.parameters.parameters} | {EPOCH: "s"}
    fixed = 'causality="parameter" variability="fixed" initial="exact" start="{!r}"'
    told += [Variable(name, fixed.format(float(value)), units[name]) for name, value in plan.parameters.items()]
    indicator = 'causality="local" variability="continuous" initial="calculated"'
    told += [Variable(name, indicator, "K") for name in indicators(plan)]
    assert len(told) - 2 * len(plan.relays) == 1 + 2 * n + len(plan.inputs) + len(spec.sensors) + len(plan.parameters)
    return told


def indicators(plan: _Plan) -> list[str]:
    """Return the names of the event indicators: how far each thermostat is from being called on, and off."""
    names = [plan.network.nodes[relay.state] for relay in plan.relays]
    return [f"{name}.{side}" for name in names for side in ("to_on", "to_off")]


def model_description(model: CalibratedModel) -> str:
    """Return ``modelDescription.xml``."""
    told, spec, n = variables(model), model.spec, len(model.network().nodes)
    name = _identifier(model)
    first_output = next(i for i, v in enumerate(told) if 'causality="output"' in v.attributes)
    rows = [
        f'    <Float64 name={quoteattr(v.name)} valueReference="{i}" {v.attributes}'
        + (f" unit={quoteattr(v.unit)}" if v.unit else "")
        + "/>"
        for i, v in enumerate(told)
    ]
    units = sorted({v.unit for v in told if v.unit})
    structure = [f'    <Output valueReference="{first_output + i}"/>' for i in range(len(spec.sensors))]
    structure += [f'    <ContinuousStateDerivative valueReference="{1 + n + i}"/>' for i in range(n)]
    structure += [f'    <InitialUnknown valueReference="{1 + n + i}"/>' for i in range(n)]
    structure += [f'    <InitialUnknown valueReference="{first_output + i}"/>' for i in range(len(spec.sensors))]
    first_indicator = len(told) - len(indicators(_plan(model)))
    structure += [f'    <EventIndicator valueReference="{i}"/>' for i in range(first_indicator, len(told))]
    common = f'modelIdentifier="{name}" canGetAndSetFMUState="true"'
    return "\n".join(
        [
            '<?xml version="1.0" encoding="UTF-8"?>',
            f'<fmiModelDescription fmiVersion="3.0" modelName={quoteattr(spec.twin)} instantiationToken="{_token(model)}"'
            f' generationTool="thermal-twin {__version__}" variableNamingConvention="flat">',
            f'  <ModelExchange {common} needsCompletedIntegratorStep="false"/>',
            f'  <CoSimulation {common} canHandleVariableCommunicationStepSize="true"/>',
            "  <UnitDefinitions>",
            *(f"    <Unit name={quoteattr(unit)}/>" for unit in units),
            "  </UnitDefinitions>",
            '  <DefaultExperiment startTime="0" tolerance="1e-8"/>',
            "  <ModelVariables>",
            *rows,
            "  </ModelVariables>",
            "  <ModelStructure>",
            *structure,
            "  </ModelStructure>",
            "</fmiModelDescription>",
            "",
        ]
    )


def _identifier(model: CalibratedModel) -> str:
    return "twin_" + "".join(c if c.isalnum() else "_" for c in model.spec.twin)


def write_fmu(model: CalibratedModel, out: Path) -> Json:
    """Write a model as an FMU for Model Exchange and Co-Simulation.

    Parameters
    ----------
    model
        A calibrated model.
    out
        The file to write.

    Returns
    -------
    dict
        ``platform`` for which a binary lies in it, None where no C compiler was found: the sources always do.

    Raises
    ------
    ModelError
        If part of the model has no form in C, or the compiler refuses the sources.
    """
    generated, name = c_source(model), _identifier(model)
    runtime = {path.name: path.read_text(encoding="utf-8") for path in sorted(RUNTIME.iterdir())}
    sources = runtime | generated
    build = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<fmiBuildDescription fmiVersion="3.0">',
        f'  <BuildConfiguration modelIdentifier="{name}">',
        '    <SourceFileSet language="C99">',
        *(f'      <SourceFile name="{file}"/>' for file in sources if file.endswith(".c")),
        "    </SourceFileSet>",
        "  </BuildConfiguration>",
        "</fmiBuildDescription>",
        "",
    ]
    with tempfile.TemporaryDirectory() as folder:
        for file, text in sources.items():
            (Path(folder) / file).write_text(text, encoding="utf-8")
        library = _compiled(Path(folder), name)
        with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as unit:
            unit.writestr("modelDescription.xml", model_description(model))
            for file, text in sources.items():
                unit.writestr(f"sources/{file}", text)
            unit.writestr("sources/buildDescription.xml", "\n".join(build))
            if library is not None:
                unit.write(library, f"binaries/{_platform()}/{library.name}")
    return {"platform": None if library is None else _platform()}


def _platform() -> str:
    machine = {"AMD64": "x86_64", "arm64": "aarch64"}.get(platform.machine(), platform.machine())
    system = {"Linux": "linux", "Darwin": "darwin", "Windows": "windows"}[platform.system()]
    return f"{machine}-{system}"


def _compiled(folder: Path, name: str) -> Path | None:
    """Return the shared library of the sources in a folder; None without a compiler."""
    compiler = next((found for c in COMPILERS if (found := shutil.which(c))), None)
    if compiler is None:
        return None
    suffix = {"Darwin": "dylib", "Windows": "dll"}.get(platform.system(), "so")
    library = folder / f"{name}.{suffix}"
    flags = ["-O2", "-std=gnu99", "-shared", "-fPIC", "-fvisibility=hidden", "-o", str(library)]
    command = [compiler, *flags, *(str(path) for path in sorted(folder.glob("*.c"))), "-lm"]
    run = subprocess.run(command, capture_output=True, text=True)
    if run.returncode != 0:
        raise ModelError(f"{compiler} refuses the C of the model: {run.stderr.strip().splitlines()[-1:] or ['?']}")
    return library
