"""Every request of the client as data: what to send, what comes back, and whether it may be sent twice."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from pydantic import BaseModel

from service import schemas

T = TypeVar("T", bound=BaseModel)
Parameters = Mapping[str, str | int | float | None]
Values = Mapping[str, Sequence[float | None]]


@dataclass(frozen=True)
class Call(Generic[T]):
    """One request. ``repeatable`` ones are sent again when an answer is lost."""

    method: str
    path: str
    answer: type[T]
    body: Any = None
    parameters: Parameters = field(default_factory=dict)
    repeatable: bool = True

    def query(self) -> dict[str, str | int | float]:
        """Return the parameters that have a value."""
        return {name: value for name, value in self.parameters.items() if value is not None}


class Nothing(BaseModel):
    """The empty answer of a deletion."""


def twins() -> Call[schemas.TwinList]:
    """List every twin."""
    return Call("GET", "/v1/twins", schemas.TwinList)


def twin(name: str) -> Call[schemas.TwinDetail]:
    """Inspect one twin."""
    return Call("GET", f"/v1/twins/{name}", schemas.TwinDetail)


def register(specification: Mapping[str, Any]) -> Call[schemas.TwinDetail]:
    """Register a specification; the same one again changes nothing."""
    return Call("POST", "/v1/twins", schemas.TwinDetail, body=dict(specification))


def revise(name: str, specification: Mapping[str, Any]) -> Call[schemas.RevisedTwin]:
    """Give a twin another specification; the same one again changes nothing."""
    return Call("PUT", f"/v1/twins/{name}", schemas.RevisedTwin, body=dict(specification))


def delete(name: str) -> Call[Nothing]:
    """Delete a twin."""
    return Call("DELETE", f"/v1/twins/{name}", Nothing, repeatable=False)


def ingest(name: str, time: Sequence[str | float], values: Values) -> Call[schemas.IngestReport]:
    """Send samples; repeated ones are recognised, so the request may be sent again."""
    return Call("POST", f"/v1/twins/{name}/telemetry", schemas.IngestReport, body={"time": time, "values": values})


def archive(name: str, parameters: Parameters) -> Call[schemas.Archive]:
    """Read a part of the archive."""
    return Call("GET", f"/v1/twins/{name}/telemetry", schemas.Archive, parameters=parameters)


def start_job(name: str, kind: schemas.JobKind, settings: Mapping[str, Any]) -> Call[schemas.Job]:
    """Start a calibration or a diagnosis."""
    return Call("POST", f"/v1/twins/{name}/{_ROOM[kind]}", schemas.Job, body=dict(settings), repeatable=False)


def job(name: str, kind: schemas.JobKind, job_id: str) -> Call[schemas.Job]:
    """Look at a job."""
    return Call("GET", f"/v1/twins/{name}/{_ROOM[kind]}/{job_id}", schemas.Job)


def jobs(name: str, kind: schemas.JobKind) -> Call[schemas.JobList]:
    """List the jobs of one kind."""
    return Call("GET", f"/v1/twins/{name}/{_ROOM[kind]}", schemas.JobList)


def cancel_job(name: str, kind: schemas.JobKind, job_id: str) -> Call[schemas.Job]:
    """Cancel a job."""
    return Call("DELETE", f"/v1/twins/{name}/{_ROOM[kind]}/{job_id}", schemas.Job)


def models(name: str) -> Call[schemas.ModelList]:
    """List the versions of the model."""
    return Call("GET", f"/v1/twins/{name}/models", schemas.ModelList)


def model(name: str, version: int) -> Call[schemas.ModelDetail]:
    """Inspect one version with the model itself."""
    return Call("GET", f"/v1/twins/{name}/models/{version}", schemas.ModelDetail)


def activate(name: str, version: int) -> Call[schemas.ModelInfo]:
    """Make one version the active one."""
    return Call("POST", f"/v1/twins/{name}/models/{version}/activate", schemas.ModelInfo)


def forecast(name: str, request: Mapping[str, Any]) -> Call[schemas.Forecast]:
    """Ask for a forecast."""
    return Call("POST", f"/v1/twins/{name}/forecasts", schemas.Forecast, body=dict(request))


def residuals(name: str, parameters: Parameters) -> Call[schemas.Residuals]:
    """Read innovations and NIS."""
    return Call("GET", f"/v1/twins/{name}/residuals", schemas.Residuals, parameters=parameters)


def anomalies(name: str, parameters: Parameters) -> Call[schemas.AnomalyList]:
    """List anomalies."""
    return Call("GET", f"/v1/twins/{name}/anomalies", schemas.AnomalyList, parameters=parameters)


def delete_telemetry(name: str, parameters: Parameters) -> Call[schemas.Deletion]:
    """Take a part of the archive out."""
    path = f"/v1/twins/{name}/telemetry"
    return Call("DELETE", path, schemas.Deletion, parameters=parameters, repeatable=False)


def undo_deletion(name: str, deletion: int) -> Call[schemas.Deletion]:
    """Put back what a deletion took."""
    return Call("POST", f"/v1/twins/{name}/telemetry/deletions/{deletion}/undo", schemas.Deletion, repeatable=False)


def alarms(name: str) -> Call[schemas.AlarmList]:
    """List the alarms of limits."""
    return Call("GET", f"/v1/twins/{name}/alarms", schemas.AlarmList)


_ROOM: dict[schemas.JobKind, str] = {"calibration": "calibrations", "diagnosis": "diagnoses"}
