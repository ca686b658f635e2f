"""The one exception for everything that the user can fix, and warnings that name the user's own
line.
"""

import inspect
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager


class InputError(ValueError):
    """An invalid input that the user can fix: a file, an array or an option.

    The message is one line: the name of the input, what was expected, what was found, and the
    remedy.

    Examples
    --------
    >>> try:
    ...     tetopt.load_phantom("spehre")
    ... except tetopt.InputError as error:
    ...     print(error)
    phantom 'spehre': no such phantom; use one of constant, disc_2d, ...
    """


class Remark(UserWarning):
    """A warning of what may be as intended: callers that know that it is ignore this category."""


class Note(UserWarning):
    """A warning that runs report as a note: what was left out or renamed, and why."""


def warn(message: str, category: type[UserWarning] = UserWarning) -> None:
    """Issue a warning that names the first line outside tetopt, at whatever call depth."""
    n_inside, frame = 0, inspect.currentframe()
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] == "tetopt":
        n_inside, frame = n_inside + 1, frame.f_back
    warnings.warn(message, category, stacklevel=n_inside + 1)


@contextmanager
def prefix_errors(words: object) -> Iterator[None]:
    """Begin InputErrors of this context with the name of a file or an option, unless they do."""
    try:
        yield
    except InputError as error:
        begins = str(error).startswith(str(words))
        raise InputError(str(error) if begins else f"{words}: {error}") from error


def error_words(error: Exception) -> str:
    """Describe an error in words: begins with the name of the file, or states the failed
    allocation.
    """
    if isinstance(error, MemoryError):
        return (
            f"not enough memory: {error}".removesuffix(": ")
            + "; use fewer nodes, a part of the image or `max_gb`"
        )
    if isinstance(error, OSError) and error.filename is not None:
        return f"{os.fsdecode(error.filename)}: {error.strerror}"
    return str(error)
