"""Structured logs: one JSON object per line on stderr, never a key or a body."""

import logging
import re
import sys
from datetime import UTC, datetime

import orjson

_QUERY = re.compile(r"\?[^\s\"']+")
"""A query in a line of the HTTP server may hold a key."""
REFUSED_SOCKET = "ASGI callable returned without completing handshake."
"""What uvicorn 0.54 says as an error of every web socket that was refused with a response, though it told so before."""
_STANDARD = frozenset(logging.makeLogRecord({}).__dict__) | {"message", "asctime", "taskName", "color_message"}


class JsonLines(logging.Formatter):
    """Formats a record as one line of JSON with its extra fields."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        message = record.getMessage()
        entry = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": _QUERY.sub("?…", message) if record.name.startswith("uvicorn") else message,
        }
        entry |= {name: value for name, value in record.__dict__.items() if name not in _STANDARD}
        if record.exc_info:
            entry["exception"] = self.formatException(record.exc_info)
        return orjson.dumps(entry, default=str).decode()


def start_logging(level: str) -> None:
    """Send the service's and the server's logs to stderr."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonLines())
    handler.addFilter(lambda record: record.msg != REFUSED_SOCKET)
    for name in ("service", "uvicorn"):
        logger = logging.getLogger(name)
        logger.handlers = [handler]
        logger.setLevel(level.upper())
        logger.propagate = False
