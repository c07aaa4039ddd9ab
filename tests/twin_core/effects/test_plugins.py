"""Effects from files and installed packages: found, read back, and refused in one line that says what to do."""

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.louver import PLUGIN
from twin_core.effects import REGISTRY, effect_from_json, effect_to_json, load_effects
from twin_core.effects.plugins import effects_in_file
from twin_core.effects.registry import Registry
from twin_core.effects.testbed import active_effect
from twin_core.errors import PluginError, SpecError

pytestmark = pytest.mark.usefixtures("plugins_forgotten")

Write = Callable[[str], Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    def write(text: str) -> Path:
        file = tmp_path / "mine.py"
        file.write_text(text)
        return file

    return write


def test_an_effect_of_a_file_is_one_of_all() -> None:
    assert "louver" not in REGISTRY
    (louver,) = load_effects([PLUGIN])
    assert REGISTRY["louver"] is louver and list(REGISTRY)[-1] == "louver"
    assert load_effects([PLUGIN.parent / ".." / "effects" / "louver.py"]) == [louver], "once is enough"


def test_a_model_file_remembers_the_plugin() -> None:
    (louver,) = load_effects([PLUGIN])
    effect = active_effect(louver)
    data = effect_to_json(effect)
    assert data["plugin"] == "louver.py"
    assert effect_from_json(data) == effect
    assert "plugin" not in effect_to_json(active_effect(REGISTRY["missing_conductor"]))


@pytest.mark.parametrize(
    ("plugin", "what_to_do"),
    [
        ("louver.py", r"give it with --effects louver\.py \(in the service: TWIN_EFFECTS=louver\.py\)"),
        ("package radiators", "install package radiators"),
    ],
)
def test_a_model_of_a_plugin_that_is_not_there_says_which(plugin: str, what_to_do: str) -> None:
    data = {"effect": "louver", "where": {}, "settings": {}, "values": {}, "plugin": plugin}
    with pytest.raises(SpecError, match=rf"^effects\[1\]\.effect: unknown effect 'louver', .*; {what_to_do}$"):
        effect_from_json(data, 1)


BASE = "from twin_core.effects.base import Effect\n"
WHOLE = PLUGIN.read_text()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("def f(:\n", r":1: SyntaxError: .*; correct the file"),
        ("\nimport nowhere_to_be_found\n", r":2: ModuleNotFoundError: No module named 'nowhere_to_be_found'; correct"),
        ("raise SystemExit(3)\n", r":1: SystemExit: 3; correct the file"),
        ("x = 1\n", r": defines no effect; write a subclass of twin_core\.effects\.base\.Effect"),
        (BASE, r": defines no effect; write a subclass"),
        (BASE + "class Mine(Effect):\n    pass\n", r": Mine lacks addition, parameter_specs, places, starts; define"),
        (WHOLE.replace("    sentence =", "    _ ="), r": Louver has no 'sentence'; set it in the class"),
        (WHOLE.replace('"louver"', '"hidden_mass"'), r": the name 'hidden_mass' is taken, by the vocabulary of docs/"),
        (WHOLE.replace('"R_m2", "m2"', '"R_m2", "W"'), r": effect louver: parameters: R_m2 says m2, its unit is 'W'"),
    ],
)
def test_a_broken_file_is_refused_in_one_line(write: Write, text: str, message: str) -> None:
    file = write(text)
    with pytest.raises(PluginError, match=rf"^{re.escape(str(file))}{message}") as refused:
        load_effects([file])
    assert "\n" not in str(refused.value)
    assert "louver" not in REGISTRY


@pytest.mark.parametrize(("name", "what"), [("nowhere.py", "is not there"), ("louver.txt", "is not a Python file")])
def test_what_is_no_python_file_is_refused(tmp_path: Path, name: str, what: str) -> None:
    (tmp_path / "louver.txt").write_text(WHOLE)
    with pytest.raises(PluginError, match=rf"{name}: {what}; name a file \.py that defines an effect"):
        load_effects([tmp_path / name])


def test_two_files_with_one_name_are_refused(write: Write) -> None:
    load_effects([PLUGIN])
    with pytest.raises(PluginError, match=rf"mine\.py: the name 'louver' is taken, by {re.escape(str(PLUGIN))}; give"):
        load_effects([write(WHOLE)])


def install(folder: Path, point: str, module: str = WHOLE) -> None:
    """Lay down what an installed package with an entry point leaves."""
    (folder / "radiators_installed.py").write_text(module)
    info = folder / "radiators-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: radiators\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[thermal_twin.effects]\nlouver = {point}\n")


@pytest.mark.parametrize("point", ["radiators_installed:Louver", "radiators_installed"])
def test_an_installed_package_needs_an_entry_point_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, point: str
) -> None:
    install(tmp_path, point)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(__import__("sys").modules, "radiators_installed", raising=False)
    registry = Registry(())
    assert list(registry) == ["louver"]
    assert registry["louver"].plugin == "package radiators"


@pytest.mark.parametrize(
    ("point", "message"),
    [
        ("radiators_installed:Nothing", r"entry point louver: AttributeError: .*; correct the package or uninstall it"),
        ("radiators_installed:np", r"entry point louver: defines no effect; write"),
        ("radiators_installed:RANGES_K", r"radiators_installed:RANGES_K is no effect; it must be a subclass"),
        ("radiators_gone", r"entry point louver: ModuleNotFoundError"),
    ],
)
def test_a_broken_package_is_named_every_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, point: str, message: str
) -> None:
    install(tmp_path, point)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(__import__("sys").modules, "radiators_installed", raising=False)
    registry = Registry(())
    for _ in range(2):
        with pytest.raises(PluginError, match=rf"^package radiators, .*{message}"):
            len(registry)


def test_a_helper_class_is_no_effect_of_its_own(write: Write) -> None:
    between = "class Opens(Effect):\n    keys = ('node', 'sink')\n\n\nclass Louver(Opens)"
    kinds = effects_in_file(write(WHOLE.replace("class Louver(Effect)", between)))
    assert [kind.name for kind in kinds] == ["louver"]
