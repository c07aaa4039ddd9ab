"""The dashboard and the description of the API: pages with their files, open to everybody because they hold no data."""

from pathlib import Path

import fastapi_offline
from fastapi import APIRouter, HTTPException
from fastapi.openapi.docs import get_swagger_ui_html
from starlette.responses import FileResponse, HTMLResponse
from starlette.staticfiles import StaticFiles
from starlette.types import Receive, Scope, Send

import twin_core

ROOM = Path(__file__).parents[2] / "dashboard"
POLICY = (
    "default-src 'self'; style-src 'self' 'unsafe-inline'; script-src 'self' 'unsafe-inline'; img-src 'self' data:; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)
_HEADERS = {"Content-Security-Policy": POLICY, "Cache-Control": "no-cache", "X-Content-Type-Options": "nosniff"}

router = APIRouter(include_in_schema=False)
FOLDERS = {
    "/assets/uplot": Path(twin_core.__file__).parent / "report" / "templates" / "uplot",
    "/assets/swagger": Path(fastapi_offline.__file__).parent / "static",
    "/assets": ROOM,
}
"""Where the files of the pages lie: nothing is fetched from elsewhere, a ground station may have no internet."""


class _Files(StaticFiles):
    """A folder of files, in which a web socket finds nothing."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer with a file."""
        if scope["type"] == "websocket":
            raise HTTPException(404)
        await super().__call__(scope, receive, send)


def assets() -> dict[str, StaticFiles]:
    """Return what serves each folder of files, the longer path first."""
    return {path: _Files(directory=folder) for path, folder in FOLDERS.items()}


@router.get("/")
async def page() -> FileResponse:
    """Return the page."""
    return FileResponse(ROOM / "index.html", headers=_HEADERS)


@router.get("/docs")
async def docs() -> HTMLResponse:
    """Return the description of the API, drawn by Swagger UI."""
    made = get_swagger_ui_html(
        openapi_url="openapi.json",
        title="thermal-twin: API",
        swagger_js_url="assets/swagger/swagger-ui-bundle.js",
        swagger_css_url="assets/swagger/swagger-ui.css",
        swagger_favicon_url="assets/icon.svg",
    )
    return HTMLResponse(made.body, headers=_HEADERS)


@router.get("/favicon.ico")
async def icon() -> FileResponse:
    """Return the icon."""
    return FileResponse(ROOM / "icon.svg", media_type="image/svg+xml")
