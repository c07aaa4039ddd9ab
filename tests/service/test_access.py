"""Keys and roles, and the refusal to be open to strangers."""

import httpx
import pytest

from service.keys import Role, parse_keys
from service.settings import SettingsError, read_settings
from tests.service.harness import AppClient

KEYS = "read:r-key, ingest:i-key,operate:o-key"
ROUTES = [
    ("GET", "/v1/twins", Role.read),
    ("GET", "/v1/twins/benchsat", Role.read),
    ("GET", "/metrics", Role.read),
    ("GET", "/v1/twins/benchsat/telemetry", Role.read),
    ("POST", "/v1/twins/benchsat/telemetry", Role.ingest),
    ("POST", "/v1/twins", Role.operate),
    ("DELETE", "/v1/twins/benchsat", Role.operate),
]


@pytest.mark.parametrize(("method", "path", "least"), ROUTES)
def test_each_role_may_do_its_part_and_no_more(make_client, method: str, path: str, least: Role) -> None:
    client: AppClient = make_client(api_keys=KEYS)
    for role in Role:
        headers = {"Authorization": f"Bearer {role.name[0]}-key"}
        status = client.request(method, path, headers=headers).status_code
        assert (status == 403) == (role < least), (role, status)
        assert status != 401


@pytest.mark.parametrize("header", [{}, {"Authorization": "Bearer x"}, {"Authorization": "Basic o-key"}])
def test_without_a_valid_key_nothing_is_answered(make_client, header: dict[str, str]) -> None:
    client: AppClient = make_client(api_keys=KEYS)
    for method, path, _ in ROUTES:
        response = client.request(method, path, headers=header)
        assert response.status_code == 401
        assert response.headers["www-authenticate"] == "Bearer"
        assert response.headers["content-type"] == "application/problem+json"


@pytest.mark.parametrize("path", ["/healthz", "/readyz", "/docs", "/openapi.json"])
def test_open_paths_need_no_key(make_client, path: str) -> None:
    """Nor does what a probe adds against caches upset them."""
    client: AppClient = make_client(api_keys=KEYS)
    assert client.get(path).status_code == client.get(path, params={"nocache": "1"}).status_code == 200


def test_keys_are_checked_before_the_body_is_read(make_client) -> None:
    client: AppClient = make_client(api_keys=KEYS, max_body_bytes=1024)
    response = client.post("/v1/twins/benchsat/telemetry", content=b" " * 5000)
    assert response.status_code == 401


def test_without_keys_only_this_machine_and_no_foreign_page_is_served(client: AppClient) -> None:
    far = httpx.ASGITransport(client.app, client=("192.0.2.7", 4000))

    async def ask(**headers: str) -> int:
        async with httpx.AsyncClient(transport=far, base_url="http://127.0.0.1") as http:
            return (await http.get("/v1/twins", headers=headers)).status_code

    assert client.portal.call(ask) == 403
    assert client.get("/v1/twins", headers={"origin": "http://evil.example"}).status_code == 403
    assert client.get("/v1/twins", headers={"origin": "http://127.0.0.1"}).status_code == 200


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("evil.example", 403),
        ("evil.example:8000", 403),
        ("192.0.2.7", 403),
        ("[2001:db8::1]:80", 403),
        ("[::1", 403),
        ("127.0.0.1:8000", 200),
        ("127.1.2.3", 200),
        ("localhost:8000", 200),
        ("[::1]:8000", 200),
        ("twin", 200),
    ],
)
def test_without_keys_a_page_cannot_pass_off_its_own_name_as_this_machine(
    client: AppClient, host: str, status: int
) -> None:
    assert client.get("/v1/twins", headers={"host": host}).status_code == status
    assert client.get("/healthz", headers={"host": host}).status_code == 200


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.0.2.7", "example.org"])
def test_other_addresses_need_keys(host: str) -> None:
    with pytest.raises(SettingsError, match="TWIN_API_KEYS is empty"):
        read_settings(host=host)
    found = read_settings(host=host, api_keys=KEYS).keys.find(b"o-key")
    assert found is not None and found.role is Role.operate


@pytest.mark.parametrize("host", ["127.0.0.1", "127.8.8.8", "::1", "localhost"])
def test_loopback_needs_none(host: str) -> None:
    assert not read_settings(host=host).keys.needed


@pytest.mark.parametrize("text", ["key", "admin:key", "read:", ":key", "read:a,ingest:a"])
def test_malformed_keys_are_refused_without_being_shown(text: str) -> None:
    with pytest.raises(ValueError, match=r"pair \d"):
        parse_keys(text)
    with pytest.raises(SettingsError, match="TWIN_API_KEYS") as caught:
        read_settings(api_keys=text)
    assert "key'" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "value"),
    [("TWIN_PORT", "70000"), ("TWIN_PORT", "x"), ("TWIN_DATABASE_URL", "postgres://x"), ("TWIN_MAX_BODY_BYTES", "-1")],
)
def test_wrong_settings_are_named(monkeypatch: pytest.MonkeyPatch, name: str, value: str) -> None:
    monkeypatch.setenv(name, value)
    with pytest.raises(SettingsError, match=name):
        read_settings()


def test_made_up_methods_do_not_grow_the_metrics(make_client) -> None:
    client: AppClient = make_client(api_keys=KEYS)
    for number in range(5):
        assert client.request(f"MADEUP{number}", "/v1/twins").status_code == 401
    metrics = client.get("/metrics", headers={"Authorization": "Bearer r-key"}).text
    assert "MADEUP" not in metrics and 'method="other"' in metrics
