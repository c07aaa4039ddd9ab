"""Who may import whom: read from the source, so that nothing has to be imported to find out."""

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("thermal_twin", "twin_core", "service", "replay")

ROOMS = (
    *("constants", "errors", "_typing", "progress", "units", "files", "csv_table", "side_by_side", "once", "wording"),
    *("parameters", "telemetry", "orbit", "quality"),
    *("network", "gp", "telemetry_csv", "fem"),
    "interchange",
    *("effects", "simulate", "latent_force"),
    "calibrate",
    *("assimilate", "anomaly", "forecast", "flows", "fmu", "holdout"),
    *("discover", "missing_heat", "report", "compiled", "closed_loop", "family"),
)
"""The rooms of twin_core from left to right: each may use only those before it."""

SERVICE_ROOMS = (
    *("errors", "instants", "keys", "settings", "memory", "schemas", "calls", "client"),
    *("store", "workbench", "monitoring", "twins"),
    *("stream", "fleet", "jobs", "live", "archive"),
    "running",
    *("http", "app", "server", "worker", "__main__"),
)
"""The rooms of the service from left to right: each may use only those before it."""

TORCH_ROOM = "twin_core.calibrate.neural_ode"
"""The one module that may import torch."""


@cache
def modules() -> dict[str, Path]:
    """Return every module of the product by its dotted name."""
    found = {}
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
            found[name.removesuffix(".__init__")] = path
    return found


def _targets(node: ast.AST, module: str) -> list[str]:
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if isinstance(node, ast.ImportFrom):
        assert node.level == 0, f"{module}: relative import; write the full name"
        source = node.module or ""
        return [f"{source}.{a.name}" if f"{source}.{a.name}" in modules() else source for a in node.names]
    return []


@cache
def imports(module: str, *, lazy: bool) -> frozenset[str]:
    """Return what a module imports, with or without what it imports only inside functions or for type checkers."""
    tree = ast.parse(modules()[module].read_text())
    skipped: set[ast.AST] = set()
    if not lazy:
        for node in ast.walk(tree):
            guarded = isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)
            if guarded or isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                skipped |= set(ast.walk(node))
    nodes = (node for node in ast.walk(tree) if node not in skipped)
    return frozenset(target for node in nodes for target in _targets(node, module))


def room(module: str) -> str:
    """Return the room of a module within its package."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else ""


@pytest.mark.parametrize("module", [m for m in modules() if m.startswith(("twin_core.", "service."))])
def test_rooms_use_only_rooms_to_their_left(module: str) -> None:
    package, own = module.split(".")[0], room(module)
    rooms = ROOMS if package == "twin_core" else SERVICE_ROOMS
    assert own in rooms, f"{own} is a new room: give it its place here and in ARCHITECTURE.md"
    for target in imports(module, lazy=True):
        if target.startswith(f"{package}.") and room(target) != own:
            assert rooms.index(room(target)) < rooms.index(own), f"{module} imports {target}"


@pytest.mark.parametrize("module", modules())
def test_packages_point_one_way(module: str) -> None:
    for target in imports(module, lazy=True):
        package = target.split(".")[0]
        if module.startswith("twin_core"):
            assert package not in ("service", "replay", "fastapi", "starlette", "httpx", "mcap", "uvicorn"), target
        if module.startswith("thermal_twin"):
            assert package not in ("service", "replay"), f"{module} imports {target}"
        elif package == "thermal_twin":
            raise AssertionError(f"{module} imports {target}: the facade stands on all, nothing on it")
        if module.startswith("service"):
            assert package != "replay", f"{module} imports {target}"
        if module.startswith("replay") and not module.startswith("replay.cli"):
            allowed = package != "twin_core" and (
                package != "service" or target in ("service.client", "service.schemas")
            )
            assert allowed, f"{module} imports {target}"


def test_no_cycles() -> None:
    done: set[str] = set()

    def visit(module: str, path: tuple[str, ...]) -> None:
        assert module not in path, "cycle: " + " -> ".join([*path[path.index(module) :], module])
        if module not in done:
            for target in sorted(imports(module, lazy=False) & modules().keys()):
                visit(target, (*path, module))
            done.add(module)

    for module in modules():
        visit(module, ())


def test_torch_lives_in_one_room() -> None:
    users = [m for m in modules() if any(t.split(".")[0].startswith("torch") for t in imports(m, lazy=True))]
    assert users in ([], [TORCH_ROOM])


def test_nobody_drags_torch_in() -> None:
    others = [module for module in modules() if module != TORCH_ROOM and not module.endswith("__main__")]
    code = f"import importlib, sys; [importlib.import_module(m) for m in {others!r}]; print('torch' in sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert run.stdout.strip() == "False"


def test_clients_do_not_load_the_service() -> None:
    assert ast.get_docstring(ast.parse(text := modules()["service"].read_text())) or not text.strip()
    assert not imports("service", lazy=True)
    heavy = ["fastapi", "uvicorn", "scipy", "numba", "skfem", "pandas"]
    code = f"import sys, service.client, replay.player; print([m for m in {heavy!r} if m in sys.modules])"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert run.stdout.strip() == "[]"


def test_facades_need_no_compiler() -> None:
    code = "import sys, twin_core.network.spec_io, twin_core.telemetry; print('numba' in sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert run.stdout.strip() == "False"
