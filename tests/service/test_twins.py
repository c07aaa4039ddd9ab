"""Registering, listing, inspecting and deleting twins."""

from tests.service.harness import AppClient


def test_life_of_a_twin(client: AppClient, spec: dict) -> None:
    assert client.get("/v1/twins").json() == {"twins": []}
    first = client.post("/v1/twins", json=spec)
    assert first.status_code == 201
    assert first.headers["location"] == "/v1/twins/benchsat"
    reordered = dict(reversed(spec.items()))
    assert client.post("/v1/twins", json=reordered).status_code == 200
    assert client.post("/v1/twins", json={**spec, "loads": []}).status_code == 409
    assert [twin["id"] for twin in client.get("/v1/twins").json()["twins"]] == ["benchsat"]
    detail = client.get("/v1/twins/benchsat").json()
    assert detail["specification"]["nodes"][0]["id"] == "px"
    assert (detail["samples"], detail["last_time"], detail["active_model"]) == (0, None, None)
    assert client.delete("/v1/twins/benchsat").status_code == 204
    assert client.delete("/v1/twins/benchsat").status_code == 404
    assert client.get("/v1/twins/benchsat").status_code == 404
    assert client.post("/v1/twins", json={**spec, "loads": []}).status_code == 201


def test_deleting_takes_the_archive_along(registered: AppClient, spec: dict) -> None:
    registered.post("/v1/twins/benchsat/telemetry", json={"time": [1.0], "values": {"T_px": [290.0]}})
    registered.delete("/v1/twins/benchsat")
    registered.post("/v1/twins", json=spec)
    assert registered.get("/v1/twins/benchsat/telemetry").json()["samples"] == 0


def test_twins_survive_a_restart(make_client, spec: dict) -> None:
    first = make_client()
    first.post("/v1/twins", json=spec)
    first.post("/v1/twins/benchsat/telemetry", json={"time": [1.0], "values": {"T_px": [290.0]}})
    first.close()
    second = make_client()
    assert second.get("/v1/twins/benchsat").json()["samples"] == 1
    assert second.post("/v1/twins", json=spec).status_code == 200
