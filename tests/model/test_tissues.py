"""Labels merged into tissues: groups in words and files, and the tables that come with tetopt."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from refusals import refusal

import tetopt
from tetopt.contents.labels import LARGEST_LABEL
from tetopt.model.tissues import _members, groups_of, merge_labels, numbers_by_name

ROW = tetopt.Image(np.array([[0.0, 2.0, 41.0, 3.0, 42.0, 511.0]]))


def owner(merge):
    """The group's name of each label."""
    groups = groups_of(merge)
    names = {group.label: group.name for group in groups}
    return {
        label: names[number] for label, number in _members(groups, {}, np.arange(3000))[0].items()
    }


def test_ranges_rest_and_zero():
    merged = merge_labels(ROW, "grey=3,42; rest=*")
    assert merged.labels.data.tolist() == [[0.0, 2.0, 2.0, 1.0, 1.0, 2.0]]
    assert merged.numbers == {0: 0, 2: 2, 3: 1, 41: 2, 42: 1, 511: 2}
    assert_array_equal(merged.labels.affine, ROW.affine)
    merged = merge_labels(ROW, "9:low = 0-3; grey matter=40 - 42, 500-530;")
    assert merged.labels.data.tolist() == [[9.0, 9.0, 2.0, 9.0, 2.0, 2.0]]
    assert merged.names == {9: "low", 2: "grey matter"}


def test_members_by_name():
    names = {2: "Left White", 41: "Right White", 3: "cortex", 42: "cortex"}
    merged = merge_labels(ROW, "white=Left White, right white; grey=cortex; 0:air=511", names)
    assert merged.labels.data.tolist() == [[0.0, 1.0, 1.0, 2.0, 2.0, 0.0]]
    with refusal('`merge`: label "cortx": no label has this name; did you mean cortex'):
        merge_labels(ROW, "grey=cortx", names)


@pytest.mark.parametrize(
    ("merge", "match"),
    [
        ("asge", 'expected NAME=LABELS.* aseg, synthseg, simnibs, got "asge"'),
        ("", 'got ""'),
        ("white=", 'got "white="'),
        ("white=2;;=3", 'got "=3"'),
        ("white=2,,3", 'got "white=2,,3"'),
        ("white=2=3", 'got "white=2=3"'),
        ("white=2; white=3", "a different name for each group, got white twice"),
        ("white=2; 1:grey=3", "a different label for each group, got 1 twice"),
        ("4000000000:white=2; rest=*", f"group numbers up to {LARGEST_LABEL}"),
        ("white=*; grey=*", r"expected \* in at most one group"),
        ("white=2,41; grey=3,40-42; rest=*", "label 41 is in two groups, white and grey"),
        ("white=41-2; rest=*", f"increasing range up to {LARGEST_LABEL}, got 41-2"),
        ("white=2-4000000000; rest=*", "got 2-4000000000"),
        ("white=1.5; rest=*", 'label "1.5": labels have no names'),
        ("white=2,41", r"got no group for 3, 42, 511; add them to a group, or give NAME=\*"),
    ],
)
def test_groups_that_cannot_be(merge, match):
    with refusal(match):
        merge_labels(ROW, merge)


def test_what_is_no_label_image():
    with refusal("labels must be whole numbers"):
        merge_labels(tetopt.Image(np.array([[0.5, 1.0]])), "a=*")


def test_a_file_of_groups(tmp_path):
    file = tmp_path / "groups.toml"
    file.write_text('white = [2, 41]\ngrey = "3, 42"\n"5:soft" = ["500-530", 7]\n')
    assert merge_labels(ROW, str(file)).labels.data.tolist() == [[0.0, 1.0, 1.0, 2.0, 2.0, 5.0]]
    for text, match in (
        ("white = [2, 41]\ngrey = 41", "`merge`: label 41 is in two groups, white and grey"),
        ("white = []", 'groups.toml: `merge`: expected NAME=LABELS.*got "white="'),
        ("white = 2\nwhite = 3", "groups.toml: expected TOML"),
        ("", "groups.toml: `merge`: expected NAME=LABELS"),
    ):
        file.write_text(text)
        with refusal(match):
            merge_labels(ROW, str(file))


@pytest.mark.parametrize(
    "text",
    [
        'name,labels\n# the tissues\nwhite,"2, 41"\ngrey,3,42\n5:soft,500-530\n5:soft, 7\n',
        "tissue;label\nwhite;2,41\n\ngrey;3;42;\n5:soft;500-530,7",
        "white\t2\ngrey\t3\nwhite\t41\ngrey\t42\n5:soft\t500-530\t7\n",
    ],
)
def test_rows_of_groups(tmp_path, text):
    file = tmp_path / "groups.CSV"
    file.write_text(text)
    assert merge_labels(ROW, str(file)).labels.data.tolist() == [[0.0, 1.0, 1.0, 2.0, 2.0, 5.0]]


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("white,2,41\ngrey", 'groups.csv: expected rows of a name and values, got "grey"'),
        ("white,2\ngrey,", 'groups.csv: expected rows .* got "grey,"'),
        ("white,2,41\ngrey,41", "`merge`: label 41 is in two groups, white and grey"),
        ("name,labels\n", "groups.csv: `merge`: expected NAME=LABELS"),
        (
            "5:white,2\n5:grey,41",
            "groups.csv: `merge`: expected a different label for each group, got 5 twice",
        ),
    ],
)
def test_other_rows_are_refused(tmp_path, text, match):
    file = tmp_path / "groups.csv"
    file.write_text(text)
    with refusal(match):
        merge_labels(ROW, str(file))


def test_presets_number_tissues_as_simnibs_does():
    for preset in ("aseg", "synthseg"):
        tissues = {group.label: group.name for group in groups_of(preset)}
        assert tissues == {1: "white", 2: "grey", 3: "fluid", 4: "bone", 5: "soft", 0: "air"}
        assert owner(preset)[16] == "white"  # the brain stem
    simnibs = groups_of("simnibs")
    assert all(group.members == (str(group.label),) for group in simnibs)
    assert {group.label for group in simnibs} == {*range(1, 13), 16, 19, 20, 24, 25}


def test_presets_agree_on_what_both_have():
    aseg, synthseg = owner("aseg"), owner("synthseg")
    # training maps have other structures there
    both = (aseg.keys() & synthseg.keys()) - set(range(130, 200))
    assert len(both) > 80
    assert {label: aseg[label] for label in both} == {label: synthseg[label] for label in both}
    bones = {label: synthseg[label] for label in (502, 507, 508, 509, 511, 514, 515, 516, 530)}
    assert {label: aseg[label + 400] for label in bones} == bones


def test_labels_that_share_a_name_are_the_smallest():
    assert numbers_by_name({41: "white", 2: "white", 3: "grey", 77: "white", 5: "White"}) == {
        41: 2,
        77: 2,
    }
