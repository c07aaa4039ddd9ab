"""Errors of the replayer: one root, each message names the file, topic or option and says what to do."""


class ReplayError(Exception):
    """A recording, a mapping or an option is wrong, or the service cannot be reached."""


class RecordingError(ReplayError):
    """A recording cannot be read or written."""


class MappingError(ReplayError):
    """A topic of the recording finds no channel of the twin, or two find the same one."""
