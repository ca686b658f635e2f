"""Inputs are refused by an InputError of one line."""

import re
from contextlib import contextmanager

import pytest

from tetopt.errors import InputError
from tetopt.io.images import load_image


@contextmanager
def refusal(match):
    """An InputError of one line that matches is raised within."""
    with pytest.raises(InputError, match=match) as caught:
        yield caught
    assert "\n" not in str(caught.value)


def assert_refused(path, match, load=load_image, **options):
    """The reader raises InputError, in one line that starts with the path and matches, which is
    returned.
    """
    with refusal(f"{re.escape(f'{path}: ')}.*(?:{match})") as caught:
        load(path, **options)
    said = str(caught.value)
    assert said.startswith(f"{path}: ")
    return said
