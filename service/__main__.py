"""``python -m service``: serve with the settings of the environment."""

import sys

from service.monitoring.logs import start_logging
from service.server import serve
from service.settings import read_settings
from twin_core.errors import TwinError


def main() -> int:
    """Serve; return 2 with one line on stderr if the settings are wrong."""
    try:
        settings = read_settings()
        start_logging(settings.log_level)
        serve(settings, on_ready=lambda url: print(f"listening on {url}", flush=True))
    except TwinError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
