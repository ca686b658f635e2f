"""The one exception for everything the user can fix, and warnings that name the user's own line."""

import inspect
import warnings


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
