"""The files under ``deploy``: what they set, start and probe is there."""

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

from replay.cli.main import twin
from service.app import create_app
from service.settings import read_settings, unknown_variables

ROOT = Path(__file__).parents[2]
IMAGE = (ROOT / "Dockerfile").read_text()
SECRETS = {"PGPASSWORD": "secret", "TWIN_API_KEYS": "operate:key"}


def compose() -> dict[str, dict[str, Any]]:
    """Return the services of the compose file that run this software."""
    services = yaml.safe_load((ROOT / "deploy" / "compose.yaml").read_text())["services"]
    return {name: service for name, service in services.items() if service["image"] == "thermal-twin"}


def manifests(kind: str) -> dict[str, dict[str, Any]]:
    """Return the Kubernetes objects of a kind by their name."""
    objects = yaml.safe_load_all((ROOT / "deploy" / "kubernetes.yaml").read_text())
    return {one["metadata"]["name"]: one for one in objects if one["kind"] == kind}


def started() -> dict[str, tuple[dict[str, str], list[str]]]:
    """Return the environment and the command, empty: that of the image, of everything that is started."""
    baked = dict(re.findall(r"(TWIN_\w+)=(\S+)", IMAGE))
    found = {}
    for name, service in compose().items():
        asked = {key: re.sub(r"\$\{.*\}", SECRETS.get(key, ""), value) for key, value in service["environment"].items()}
        found[f"compose {name}"] = baked | asked, service.get("entrypoint", [])
    for name, deployment in manifests("Deployment").items():
        (container,) = deployment["spec"]["template"]["spec"]["containers"]
        asked = {one["name"]: one["value"] for one in container.get("env", [])}
        for source in container["envFrom"]:
            asked |= (
                manifests("ConfigMap")[source["configMapRef"]["name"]]["data"] if "configMapRef" in source else SECRETS
            )
        found[f"kubernetes {name}"] = baked | asked, container.get("command", [])
    return found


@pytest.mark.parametrize("name", started())
def test_settings_and_commands_are_there(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    environment, command = started()[name]
    assert unknown_variables(environment) == []
    for key, value in environment.items():
        monkeypatch.setenv(key, value)
    settings = read_settings()
    assert str(settings.database).startswith("postgresql://twin@") and "PGPASSWORD" in environment
    assert settings.keys and settings.host == "0.0.0.0"
    if command:
        assert command == ["twin", "worker"] and "worker" in twin.commands
    else:
        assert settings.job_workers == 0  # others do the jobs


def test_the_image_holds_what_a_fleet_needs() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    (installed,) = re.findall(r'"\.\[([\w,]+)\]"', IMAGE)
    assert {"postgres", "dask"} <= set(installed.split(",")) <= set(extras)
    assert all((ROOT / folder).is_dir() for folder in re.findall(r"^COPY (\w+) \1$", IMAGE, re.MULTILINE))


def test_what_is_probed_and_reached_is_served() -> None:
    app = create_app(read_settings(database_url="sqlite:///unused.sqlite3"))
    (port,) = re.findall(r"TWIN_PORT=(\d+)", IMAGE)
    deployment = manifests("Deployment")["twin-service"]["spec"]
    (container,) = deployment["template"]["spec"]["containers"]
    assert container["ports"] == [{"containerPort": int(port)}]
    for probe in ("readinessProbe", "livenessProbe"):
        place = container[probe]["httpGet"]
        assert place["port"] == int(port) and place["path"] in app.openapi()["paths"]
    (service,) = manifests("Service").values()
    assert service["spec"]["ports"][0]["targetPort"] == int(port)
    assert service["spec"]["selector"].items() <= deployment["template"]["metadata"]["labels"].items()
    for one in manifests("Deployment").values():
        labels = one["spec"]["template"]["metadata"]["labels"]
        assert one["spec"]["selector"]["matchLabels"].items() <= labels.items()
