"""The manual cannot lie by omission: every route and every setting stands in it, and nothing that does not exist."""

import re
from pathlib import Path

from service.app import create_app
from service.settings import Settings, read_settings

MANUAL = (Path(__file__).parents[2] / "docs" / "service.md").read_text()


def routes() -> set[str]:
    app = create_app(read_settings(database_url="sqlite:///unused.sqlite3"))
    paths = app.openapi()["paths"]
    return {f"{method.upper()} {path}" for path, methods in paths.items() for method in methods}


def test_every_route_is_described_and_every_described_route_exists() -> None:
    described = set(re.findall(r"`((?:GET|POST|PUT|DELETE) /[^`?]*)`", MANUAL))
    assert routes() | {"GET /"} == described
    assert "`WS /v1/twins/{twin}/stream`" in MANUAL


def test_every_setting_is_described_with_its_default() -> None:
    described = dict(re.findall(r"\| `(TWIN_[A-Z_]+)` \| `?([^`|]*?)`? \|", MANUAL))
    fields = {f"TWIN_{name.upper()}": field.default for name, field in Settings.model_fields.items()}
    assert described.keys() == fields.keys()
    for name, default in fields.items():
        text = described[name]
        if default in (None, "") or name == "TWIN_API_KEYS":
            assert text in ("unset", "empty")
        elif isinstance(default, bool):
            assert text == str(default).lower()
        else:
            assert type(default)(text) == default
