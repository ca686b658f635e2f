"""The one exception for everything the user can fix, errors in words, warnings that name the user's own line."""

import inspect
import os
import warnings

# What options were called before 0.1.0, where the nearest name now is another one's.
FORMER_NAMES = {"size_max": "edge_size"}


class InputError(ValueError):
    """An input that the user can mend: a file, an array or an option.

    The message is one line: what was looked at, what was expected, what came, and what to do.

    Examples
    --------
    >>> try:
    ...     tetopt.load_phantom("spehre")
    ... except tetopt.InputError as error:
    ...     print(error)
    phantom 'spehre': no such phantom; give one of constant, disc_2d, ...
    """


def warn(message: str) -> None:
    """Issue a UserWarning that names the first line outside tetopt, however many calls within tetopt led here."""
    n_inside, frame = 0, inspect.currentframe()
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] == "tetopt":
        n_inside, frame = n_inside + 1, frame.f_back
    warnings.warn(message, stacklevel=n_inside + 1)


def error_words(error: Exception) -> str:
    """What went wrong: of a file with its name first, of memory with what was to be laid out."""
    if isinstance(error, MemoryError):
        return f"not enough memory: {error}".removesuffix(": ") + "; take fewer nodes, a part of the image or `max_gb`"
    if isinstance(error, OSError) and error.filename is not None:
        return f"{os.fsdecode(error.filename)}: {error.strerror}"
    return str(error)
