"""What can be wrong with a file that was recorded."""


class RecordingError(ValueError):
    """A file that cannot be read as asked; the text says what to do."""
