"""Documentation that cannot lie: every command, option, effect, route and setting stands in it, and its examples run."""

import re
import shlex
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
import yaml

import thermal_twin
from replay.cli.main import main, twin
from service.app import ROUTERS
from service.settings import Settings
from twin_core.calibrate import METHODS
from twin_core.effects import REGISTRY
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Record

ROOT = Path(__file__).parent.parent
DOCS = {path.name: path.read_text() for path in [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]}
EVERYTHING = "\n".join(DOCS.values())


def section(page: str, title: str) -> str:
    """Return the text under a second-level heading."""
    found = re.search(rf"^## {re.escape(title)}\n(.*?)(?=^## |\Z)", DOCS[page], re.MULTILINE | re.DOTALL)
    assert found is not None, f"{page} has no section '{title}'"
    return found[1]


def blocks(text: str, language: str) -> list[str]:
    """Return the fenced code blocks of one language."""
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def commands() -> dict[str, click.Command]:
    """Return every command by its words, those of groups included."""
    found: dict[str, click.Command] = {}
    for name, command in twin.commands.items():
        found |= {f"{name} {word}": part for word, part in getattr(command, "commands", {}).items()} or {name: command}
    return found


@pytest.mark.parametrize("name", commands())
def test_every_option(name: str) -> None:
    text = section("cli.md", f"twin {name}")
    for parameter in commands()[name].params:
        if isinstance(parameter, click.Option):
            for flag in parameter.opts:
                assert f"`{flag}" in text, f"docs/cli.md: twin {name} {flag} is missing"


def test_no_option_that_is_gone() -> None:
    for name, command in commands().items():
        known = {flag for parameter in command.params for flag in parameter.opts}
        rows = re.findall(r"^\| `(--[a-z-]+)", section("cli.md", f"twin {name}"), re.MULTILINE)
        assert set(rows) <= known, name


@pytest.mark.parametrize("method", METHODS)
def test_every_method(method: str) -> None:
    assert f"`{method}`" in section("cli.md", "twin calibrate")


@pytest.mark.parametrize("effect", REGISTRY.values(), ids=REGISTRY.keys())
def test_every_effect(effect: type) -> None:
    row = re.search(rf"^\| `{effect.name}` \| (.*?) \|", DOCS["effects.md"], re.MULTILINE)  # type: ignore[attr-defined]
    assert row is not None, f"docs/effects.md lacks {effect}"
    optional = "".join(f" (and {key})" for key in effect.optional_keys)  # type: ignore[attr-defined]
    assert row[1] == ", ".join(effect.keys) + optional  # type: ignore[attr-defined]


def test_no_effect_that_is_gone() -> None:
    assert set(re.findall(r"^\| `([a-z_]+)` \|", DOCS["effects.md"], re.MULTILINE)) == set(REGISTRY)


def test_the_walk_through_is_the_example() -> None:
    source = (ROOT / "examples" / "effects" / "louver.py").read_text()
    parts = blocks(section("effects.md", "An effect of your own"), "python")
    assert len(parts) == 4
    for part in parts:
        assert part in source, part


@pytest.mark.parametrize("path", sorted({route.path for router in ROUTERS for route in router.routes}))  # type: ignore[attr-defined]
def test_every_route(path: str) -> None:
    written = re.sub(r"\{[a-z_]+\}", "{}", EVERYTHING)
    # The prefix of a twin may be left out: "…/models" or "/models" in a list of its routes.
    short = re.sub(r"\{[a-z_]+\}", "{}", path.removeprefix("/v1/twins/{twin}")) or "/v1/twins/{}"
    assert path == "/favicon.ico" or short in written, f"docs/service.md lacks {path}"


@pytest.mark.parametrize("field", Settings.model_fields)
def test_every_setting(field: str) -> None:
    assert f"`TWIN_{field.upper()}`" in EVERYTHING


def test_specification_example_is_valid() -> None:
    (example,) = blocks(DOCS["specification.md"], "yaml")
    spec = load_spec(yaml.safe_load(example))
    used = set(re.findall(r"[a-z_A-Z0-9]+(?=:)", example))
    for model in (type(spec), *(type(item) for item in (*spec.nodes, *spec.loads, *spec.channels.values()))):
        assert set(model.model_fields) <= used, f"the example shows not every field of {model.__name__}"


@pytest.mark.long
def test_the_latent_force_example_finds_the_missing_heat() -> None:
    """One node that leaks to a wall, at rest until 5 W are switched on: temperatures in closed form."""
    spec = load_spec(
        {
            "twin": "t",
            "boundaries": {"wall": {"value_K": 280.0}},
            "channels": {"T": {"kind": "temperature", "unit": "K"}},
            "nodes": [{"id": "tank", "sensor": "T", "capacity_J_per_K": {"value": 2000.0}}],
            "conductors": [{"between": ["tank", "wall"], "conductance_W_per_K": {"value": 1.0}}],
        }
    )
    time_s = 60.0 * np.arange(200)
    warm_K = 280.0 + 5.0 * (1.0 - np.exp(-time_s / 2000.0))
    noisy_K = warm_K + np.random.default_rng(0).normal(0.0, 0.05, time_s.size)
    (example,) = blocks(section("latent-force.md", "From Python"), "python")
    names: dict[str, Any] = {"spec": spec, "record": Record(time_s, {"T": noisy_K})}
    exec(compile(example, "latent-force.md", "exec"), names)
    assert np.abs(names["missing_W"] - 5.0)[10:].max() < 4.0 * names["band_W"].max()
    ((label, weight),) = names["effect"].values.items()
    assert label == "coefficients[0]" and abs(weight - 5.0) < 0.1
    assert names["network"].parameters.index["learned_heat_flow(tank).coefficients[0]"] >= 0


def test_every_link_leads_somewhere() -> None:
    for path in [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]:
        for target in re.findall(r"\]\(([^)#]+)", path.read_text()):
            if "://" not in target:
                assert (path.parent / target).exists(), f"{path.name}: {target}"


def test_the_reference_lists_every_function_of_the_facade() -> None:
    page = (ROOT / "docs" / "api" / "thermal_twin.md").read_text()
    for name in thermal_twin.__all__:
        assert name == "__version__" or re.search(rf"\b{name}\b", page) or name == "TwinError", name


def test_every_page_stands_in_the_site() -> None:
    """What mkdocs.yml lists is there, and every page is listed."""
    listed = set(re.findall(r"^ +- ([a-z0-9_/-]+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE))
    assert listed == {str(path.relative_to(ROOT / "docs")) for path in (ROOT / "docs").rglob("*.md")}


def test_every_decision_follows_the_form() -> None:
    decisions = sorted((ROOT / "docs" / "adr").glob("*.md"))
    for number, path in enumerate(decisions, start=1):
        text = path.read_text()
        assert path.name.startswith(f"{number:04d}-") and text.startswith(f"# {number}. ")
        assert all(f"**{part}.**" in text for part in ("Decision", "Why", "Price"))


@pytest.mark.long
def test_quick_start_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    (commands,) = blocks(section("README.md", "Quick start"), "sh")
    lines = [line for line in commands.splitlines() if line.startswith("twin ")]
    assert len(lines) == 3
    for line in lines:
        assert main(shlex.split(line)[1:]) == 0, line
    printed = capsys.readouterr().out
    (shown,) = blocks(section("README.md", "Quick start"), "text")
    said = printed[printed.index(shown.splitlines()[0]) :].partition("held-out rmse")[0]
    number = re.compile(r"(?<![\w-])\d+\.?\d*(?!\w)")
    assert number.sub("#", said.strip()) == number.sub("#", shown.strip())
    told, found = ([float(x) for x in number.findall(text)] for text in (shown, said))
    assert told == pytest.approx(found, rel=0.1)
    assert (tmp_path / "forecast.csv").read_text().startswith("time,T_panel_mean,")
