"""The fleet: every twin at a glance, sorted, filtered and paged here, so that a page of a thousand is one of fifty."""

from collections.abc import Callable
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query

from service.http.deps import Running, reads
from service.instants import format_instant, now_us
from service.running.service import Service
from service.schemas import FleetCounts, FleetPage, FleetRow, NameList, Worst
from service.store import fleet
from service.store.errors import Missing
from service.store.fleet import Glance
from service.twins.registry import Entry

router = APIRouter(prefix="/v1/fleet", tags=["fleet"])
Sort = Literal["attention", "id", "residual", "ahead", "anomalies", "silence", "model_age"]
Only = Literal["all", "red", "yellow", "ahead", "anomalies", "stale", "no_model"]

KEPT: dict[Only, Callable[[FleetRow], bool]] = {
    "all": lambda row: True,
    "red": lambda row: row.red > 0,
    "yellow": lambda row: row.yellow > 0,
    "ahead": lambda row: row.ahead is not None,
    "anomalies": lambda row: row.open_anomalies > 0,
    "stale": lambda row: row.state in ("stale", "partly"),
    "no_model": lambda row: row.active_model is None,
}
_NEVER = "9"  # behind every instant


def _expected(row: FleetRow) -> str:
    return (row.ahead or {}).get("expected") or _NEVER


def _deviations(row: FleetRow) -> float:
    return -1.0 if row.worst is None else row.worst.deviations


ORDER: dict[Sort, Callable[[FleetRow], Any]] = {
    "attention": lambda row: (
        *(-row.red, _expected(row), -row.yellow, -row.open_anomalies, row.state not in ("stale", "partly")),
        -_deviations(row),
    ),
    "id": lambda row: row.id,
    "residual": lambda row: -_deviations(row),
    "ahead": _expected,
    "anomalies": lambda row: -row.open_anomalies,
    "silence": lambda row: -1.0 if row.silent_s is None else -row.silent_s,
    "model_age": lambda row: 1.0 if row.model_age_s is None else -row.model_age_s,
}
"""What each order puts first: what an operator should look at."""


@router.get("", dependencies=[reads])
async def page(
    service: Running,
    sort: Sort = "attention",
    reverse: bool = False,
    only: Only = "all",
    find: Annotated[str, Query(max_length=64)] = "",
    offset: Annotated[int, Query(ge=0)] = 0,
    limit: Annotated[int, Query(ge=1, le=500)] = 50,
) -> FleetPage:
    """Return a page of the twins whose id or family contains ``find``, and how many there are of each kind."""
    every = [row for row in await _rows(service) if find.lower() in f"{row.id} {row.family or ''}".lower()]
    counts = FleetCounts(**{kind: sum(map(keep, every)) for kind, keep in KEPT.items()})
    kept = sorted(filter(KEPT[only], every), key=ORDER[sort], reverse=reverse)
    return FleetPage(counts=counts, matched=len(kept), offset=offset, twins=kept[offset : offset + limit])


@router.get("/names", dependencies=[reads])
async def names(service: Running) -> NameList:
    """Return the id of every twin, in order."""
    return NameList(twins=sorted(entry.name for entry in service.registry))


async def _rows(service: Service) -> list[FleetRow]:
    found: list[tuple[Glance, Entry]] = []
    for glance in await service.database.read(fleet.glances):
        try:
            found.append((glance, service.registry.get(glance.name)))
        except Missing:  # it is being deleted, or another process has just registered it
            continue
    states = await service.live.standings([entry for _, entry in found])
    at_us = now_us()
    return [
        FleetRow.model_construct(
            id=glance.name,
            family=entry.specification.get("family"),
            state=state,
            silent_s=silent_s,
            last_time=None if glance.last_us is None else format_instant(glance.last_us),
            samples=glance.samples,
            worst=_worst(glance),
            ahead=glance.ahead,
            open_anomalies=glance.open_anomalies,
            yellow=glance.yellow - glance.yellow_ahead,
            red=glance.red - glance.red_ahead,
            active_model=glance.version,
            model_age_s=None if glance.model_us is None else max(at_us - glance.model_us, 0) / 1e6,
        )
        for (glance, entry), (state, silent_s) in zip(found, states, strict=True)
    ]


def _worst(glance: Glance) -> Worst | None:
    if (vital := glance.vital) is None:
        return None
    time = format_instant(vital.time_us)
    return Worst.model_construct(
        sensor=vital.sensor, residual_K=vital.residual_K, deviations=vital.deviations, time=time
    )
