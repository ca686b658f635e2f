"""Into how many parts a mesh may be divided."""

import pytest

from tetopt.errors import InputError
from tetopt.parts.division import FEWEST_NODES_EACH, Division


@pytest.mark.parametrize(("n_parts", "nodes", "number"), [(None, 5, 1), (1, 5, 1), (2, 2 * FEWEST_NODES_EACH, 2)])
def test_as_many_parts_as_have_nodes_of_their_own(n_parts, nodes, number):
    assert Division(n_parts).checked_number(nodes) == number


def test_more_parts_are_refused():
    with pytest.raises(InputError, match=r"`parts`: expected at most 1 for 199 nodes \(100 each\), got 2$"):
        Division(2).checked_number(2 * FEWEST_NODES_EACH - 1)
