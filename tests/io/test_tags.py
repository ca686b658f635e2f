"""Tags: one for each combination of sets."""

import numpy as np
from models import sample_model

from tetopt.io.tags import tagged


def test_tags_say_which_sets_an_item_is_in():
    for sets in (sample_model(3).sets.facets, sample_model(3).sets.cells):
        tags = tagged(sets)
        assert tags.tags.min() == 1
        assert len(np.unique(tags.items, axis=0)) == len(tags.items)
        for name, members in sets.items():
            chosen = tags.items[np.isin(tags.tags, tags.tags_of[name])]
            np.testing.assert_array_equal(chosen, members)
        together = {tuple(name for name in sets if tag in tags.tags_of[name]) for tag in np.unique(tags.tags)}
        assert len(together) == tags.tags.max()  # no two tags for one combination
    assert tagged({}).tags_of == {}
