"""Requests drawn from the service's own description, fitting and not: none ends in a server error or a shapeless refusal."""

import re
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, settings

from service.app import create_app
from service.settings import read_settings
from tests.service.conftest import SPEC
from tests.service.server import FAKE, Server

pytestmark = pytest.mark.e2e

ENDLESS = "/v1/twins/{twin}/events"


def description() -> dict[str, Any]:
    """Return the description of the API with the registered twin as the only one, so that requests get beyond 404."""
    document = create_app(read_settings(database_url="sqlite:///unused.sqlite3")).openapi()
    for methods in document["paths"].values():
        for operation in methods.values():
            for parameter in operation.get("parameters", ()):
                if parameter["name"] == "twin":
                    parameter["schema"] = {"type": "string", "enum": ["benchsat"]}
    del document["paths"][ENDLESS], document["paths"]["/v1/twins/{twin}"]["delete"]
    return document


@schemathesis.serializer("application/x-ndjson")
def as_line(context: schemathesis.SerializationContext, value: Any) -> bytes:
    """Send what was drawn as it is: a text may hold any number of lines."""
    return str(value).encode()


SCHEMA = schemathesis.openapi.from_dict(description())


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with Server(tmp_path_factory.mktemp("fuzz"), command=FAKE) as running:
        client = running.client()
        client.register(SPEC)
        times = [60.0 * k for k in range(200)]
        client.ingest("benchsat", times, {"T_px": [290.0 + k % 7 for k in range(200)], "Q_px": [0.5] * 200})
        assert client.wait("benchsat", client.calibrate("benchsat")).state == "succeeded"
        yield running


def drawn(max_examples: int) -> settings:
    """Return how requests are drawn."""
    phases = [Phase.explicit, Phase.generate]
    checks = list(HealthCheck)
    return settings(
        max_examples=max_examples, deadline=None, derandomize=True, phases=phases, suppress_health_check=checks
    )


def for_each_operation(
    schema: Any, max_examples: int, name: str, judge: Callable[[Any, Server], None]
) -> dict[str, Any]:
    """Return a test of each operation under a name of its own: what parametrize makes shares one, and would run once."""

    def test() -> Callable[[Any, Server], None]:
        def judged(case: Any, server: Server) -> None:
            judge(case, server)

        return judged

    tests = {}
    for operation in (result.ok() for result in schema.get_all_operations()):
        alone = SCHEMA.include(path=operation.path, method=operation.method)
        words = re.findall(r"\w+", f"{operation.method} {operation.path}".lower())
        tests["_".join([name, *words])] = alone.parametrize()(drawn(max_examples)(test()))
    return tests


def breaks_nothing(case: Any, server: Server) -> None:
    response = case.call(base_url=server.url, timeout=60)
    assert response.status_code < 500, response.text
    if response.status_code >= 400:
        assert response.headers["content-type"] == ["application/problem+json"], response.text
        problem = response.json()
        assert problem["status"] == response.status_code and problem["detail"]
    assert "unexpected" not in server.log()


def passes_no_unknown_parameter_over(case: Any, server: Server) -> None:
    case.query = {**(case.query or {}), "surprise": "1"}
    response = case.call(base_url=server.url, timeout=60)
    assert 400 <= response.status_code < 500, response.text
    assert response.headers["content-type"] == ["application/problem+json"], response.text


globals().update(for_each_operation(SCHEMA, 8, "test_no_request_breaks_the_service", breaks_nothing))
globals().update(
    for_each_operation(
        SCHEMA.include(path_regex="^/v1/"),
        2,
        "test_no_unknown_parameter_is_passed_over",
        passes_no_unknown_parameter_over,
    )
)
