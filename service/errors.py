"""What is refused, and why: raised anywhere in the service; what HTTP makes of it is ``service.http.problems``'s affair."""

from collections.abc import Sequence

LONGEST_NAME = 80
"""A name that somebody sent is repeated up to so many characters."""

FieldErrors = Sequence[tuple[str, str]]


LONGEST_LINE = 1000
"""No answer says more than so many characters at once."""


def short(name: str, most: int = LONGEST_NAME) -> str:
    """Return a name that somebody sent as it may be repeated."""
    return name if len(name) <= most else f"{name[: most - 1]}…"


class Refusal(Exception):
    """Something is not done; ``detail`` says why in one line, ``errors`` names the fields to blame as (field, what is wrong)."""

    def __init__(self, detail: str, errors: FieldErrors = ()) -> None:
        """Keep both."""
        super().__init__(detail)
        self.detail, self.errors = detail, errors


class TooLittle(Refusal):
    """What is asked for needs more telemetry than there is."""


class NotYet(Refusal):
    """What is asked for is being worked on: whoever asks again a little later finds it."""


class TooMuch(Refusal):
    """So much of it waits already that no more is taken now."""


class BadField(Refusal):
    """One field of a request is wrong."""

    def __init__(self, field: str, reason: str) -> None:
        """Name the field as the caller wrote it."""
        field = short(field)
        super().__init__(f"{field}: {reason}", [(field, reason)])
