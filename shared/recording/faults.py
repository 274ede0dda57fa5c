"""Errors of recorded files."""


class RecordingError(ValueError):
    """A file that cannot be read as requested. The text says what to do."""
