"""The dashboard: one page with its files, open to everybody because it holds no data."""

from pathlib import Path

from fastapi import APIRouter
from starlette.responses import FileResponse
from starlette.staticfiles import StaticFiles

ROOM = Path(__file__).parent.parent / "dashboard"
POLICY = (
    "default-src 'self'; style-src 'self' 'unsafe-inline'; script-src 'self' 'unsafe-inline'; img-src 'self' data:; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)

router = APIRouter(include_in_schema=False)
assets = StaticFiles(directory=ROOM)


@router.get("/")
async def page() -> FileResponse:
    """Return the page."""
    headers = {"Content-Security-Policy": POLICY, "Cache-Control": "no-cache", "X-Content-Type-Options": "nosniff"}
    return FileResponse(ROOM / "index.html", headers=headers)


@router.get("/favicon.ico")
async def icon() -> FileResponse:
    """Return the icon."""
    return FileResponse(ROOM / "icon.svg", media_type="image/svg+xml")
