"""The one exception for everything the user can fix."""


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
