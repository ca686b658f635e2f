"""The one exception for everything the user can fix."""


class InputError(ValueError):
    """An input that the user can mend: a file, an array or an option.

    The message is one line: what was looked at, what was expected, what came, and what to do.
    """
