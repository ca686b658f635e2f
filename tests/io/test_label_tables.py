"""Tables of labels' names: each format written here, told apart by what it holds; and what is
refused.
"""

import json

import nibabel
import numpy as np
import pytest
from refusals import assert_refused, refusal

from tetopt.contents.labels import hex_colour
from tetopt.io.label_tables import NO_TABLE, LabelTable, load_label_table, own_label_table
from tetopt.model.file import table_in
from tetopt.model.label_names import label_words, labels_named, table_of_labels, table_words
from tetopt.model.sets import MOST_LETTERS, SET_NAME, interface_names, label_set_names

FREESURFER = """#$Id: FreeSurferColorLUT.txt $
#No. Label Name:                            R   G   B   A

0   Unknown                                 0   0   0   0
2   Left-Cerebral-White-Matter              245 245 245 0
3   Left-Cerebral-Cortex                    205 62  78  0
14  3rd-Ventricle                           204 182 142 0

# below are colours of others
1002 ctx-lh-caudalanteriorcingulate         125 100 160 0
"""
FREESURFER_8 = """0   Unknown          0   0   0   0
819 Left-HypoThal-noMB           0  80   0 0 2
822 Right-Fornix                27 187 253 0 3
"""
MRTRIX = """# Lookup table
0    ???         Unknown                    0   0   0   0
1    L.BSTS      ctx-lh-bankssts            25  100 40  255
74   R.RACG      ctx-rh-rostral             80  20  140 255
"""
FSL = """<?xml version="1.0" encoding="ISO-8859-1"?>
<atlas version="1.0"><header><name>Atlas</name><type>{}</type></header>
<data><label index="0" x="48" y="94" z="35">Frontal Pole</label>
<label index="48" x="25" y="70" z="32">Occipital</label></data></atlas>
"""
SNAP = """################################################
# ITK-SnAP Label Description File
# IDX   -R-  -G-  -B-  -A--  VIS MSH  LABEL
################################################
    0     0    0    0        0  0  0    "Clear Label"
    1   255    0    0        1  1  1    "Rein (gauche) / été"
    2     0  255    0     0.50  1  0    "liver"
"""
SLICER = """# Color table file C:/Users/a/Segmentation-label_ColorTable.ctbl
# 4 values
0 Background 0 0 0 0
1 artery 216 101 79 255
2 connective_tissue 111 184 210 255
3 (none) 0 0 0 0
"""
SLICER_CSV = """LabelValue,Name,Color_R,Color_G,Color_B,Color_A,\
Category_CodeMeaning,Type_CodeMeaning
1,"kidney, left",185,102,83,255,Anatomical Structure,Kidney
2,tumour,144,238,144,255,Morphologically Altered Structure,Neoplasm
"""
BIDS = (
    "index\tname\tabbreviation\tcolor\tmapping\n"
    "0\tBackground\tBG\tn/a\t0\n1\tGray Matter\tGM\t#ff53bb\t1\n2\tWhite Matter\tWM\t#2f8bbe\t2\n"
)
CSV = "label,name\n5,liver\n1,spleen\n"
FRACTIONS = "name;id;r;g;b\nliver;5;0.5;1.0;0\nspleen;1.0;;;\n"


def table_of(tmp_path, text, name="table.txt", encoding="utf-8"):
    (tmp_path / name).write_text(text, encoding=encoding)
    return load_label_table(tmp_path / name)


@pytest.mark.parametrize(
    ("text", "names", "colours"),
    [
        (
            FREESURFER,
            {
                0: "Unknown",
                2: "Left-Cerebral-White-Matter",
                3: "Left-Cerebral-Cortex",
                14: "3rd-Ventricle",
                1002: "ctx-lh-caudalanteriorcingulate",
            },
            {3: (205, 62, 78), 1002: (125, 100, 160)},
        ),
        (
            SNAP,
            {0: "Clear Label", 1: "Rein (gauche) / été", 2: "liver"},
            {1: (255, 0, 0), 2: (0, 255, 0)},
        ),
        (
            SLICER,
            {0: "Background", 1: "artery", 2: "connective_tissue"},
            {1: (216, 101, 79), 3: (0, 0, 0)},
        ),
        (SLICER_CSV, {1: "kidney, left", 2: "tumour"}, {1: (185, 102, 83), 2: (144, 238, 144)}),
        (
            BIDS,
            {0: "Background", 1: "Gray Matter", 2: "White Matter"},
            {1: (255, 83, 187), 2: (47, 139, 190)},
        ),
        (CSV, {1: "spleen", 5: "liver"}, {}),
        (FRACTIONS, {1: "spleen", 5: "liver"}, {5: (127.5, 255, 0)}),
        # the last four are the colour
        ("1 left lung 3 10 20 30 0\n", {1: "left lung 3"}, {1: (10, 20, 30)}),
        ("index,label\n1,spleen\n", {1: "spleen"}, {}),  # nilearn's columns
        ("labels,structures\n1,spleen\n", {1: "spleen"}, {}),  # SynthSeg's
        (
            FREESURFER_8,
            {0: "Unknown", 819: "Left-HypoThal-noMB", 822: "Right-Fornix"},
            {819: (0, 80, 0), 822: (27, 187, 253)},
        ),
        ("1 rib 1 10 20 30 0\n2 rib 2 40 50 60 0\n", {1: "rib 1", 2: "rib 2"}, {2: (40, 50, 60)}),
        ("1\tleft lung\t0.5\t1.0\t0\t1\n", {1: "left lung"}, {1: (127.5, 255, 0)}),
        ('1,"kidney, left",255,0,0\n', {1: "kidney, left"}, {1: (255, 0, 0)}),
        (MRTRIX, {0: "Unknown", 1: "ctx-lh-bankssts", 74: "ctx-rh-rostral"}, {74: (80, 20, 140)}),
        (
            "1 left kidney 1 2 3 0\n2 right kidney 4 5 6 0\n",
            {1: "left kidney", 2: "right kidney"},
            {2: (4, 5, 6)},
        ),
        ("1 left lung\n20  rib 3\n", {1: "left lung", 20: "rib 3"}, {}),
        ('1,spleen\n2, "liver"\n', {1: "spleen", 2: "liver"}, {}),
        ("1\tspleen\n2\tleft lung\n", {1: "spleen", 2: "left lung"}, {}),
        ("1;spleen\n2;left lung\n", {1: "spleen", 2: "left lung"}, {}),
        ('{"labels": {"background": 0, "liver": 819}}', {0: "background", 819: "liver"}, {}),
        ('{"labels": {"0": "background", "819": "liver"}}', {0: "background", 819: "liver"}, {}),
        (FSL.format("Probabilistic"), {1: "Frontal Pole", 49: "Occipital"}, {}),
        (FSL.format("Label"), {0: "Frontal Pole", 48: "Occipital"}, {}),
        (
            FSL.format("Label").replace("index", 'value="7" index', 1),
            {7: "Frontal Pole", 48: "Occipital"},
            {},
        ),
        ("index\tname\tcolor\n1\tspleen\tff8000\n", {1: "spleen"}, {1: (255, 128, 0)}),
        # a separator tells where a name ends; in blanks, all lines do
        ("1\trib 3\t10\t20\t30\n2\trib 4\t9\t8\t7\n", {1: "rib 3", 2: "rib 4"}, {2: (9, 8, 7)}),
        ("1,rib 3,10,20,30\n", {1: "rib 3"}, {1: (10, 20, 30)}),
        ("819 A 0 80 0 0 2\n820 A 1 80 0 0 2\n", {819: "A", 820: "A"}, {820: (1, 80, 0)}),
        ("819 A 0 80 0 128 2\n820 B 1 80 0 0 2\n", {819: "A", 820: "B"}, {819: (0, 80, 0)}),
        (
            "1 left kidney 1 2 3 255\n2 right liver 4 5 6 255\n",
            {1: "left kidney", 2: "right liver"},
            {2: (4, 5, 6)},
        ),
        (
            "1 v #3 1 2 3 0 # note\n2 a 4 5 6 0\n",
            {1: "v #3", 2: "a"},
            {1: (1, 2, 3), 2: (4, 5, 6)},
        ),
        ("1 liver # note\r2 spleen\r", {1: "liver", 2: "spleen"}, {}),
        # twice the same is one
        ("1 spleen 1 2 3 0\n1 spleen 1 2 3 0\n", {1: "spleen"}, {1: (1, 2, 3)}),
    ],
)
def test_names_and_colours(tmp_path, text, names, colours):
    for encoding in ("utf-8", "utf-8-sig"):
        for ends in ("\n", "\r\n"):
            table = table_of(tmp_path, text.replace("\n", ends), encoding=encoding)
            assert table.names == names
            for label, colour in colours.items():
                assert table.colours[label] == pytest.approx([part / 255 for part in colour])
    assert set(table.colours) >= set(colours)
    if not colours:
        assert table.colours == {}


def test_names_are_printable(tmp_path):
    assert table_of(tmp_path, "label,name\n1,a\x1b[31mb\n2147483647,\u202ec\n").names == {
        1: "a\\x1b[31mb",
        2147483647: "\\u202ec",
    }


def test_a_background_without_a_colour_has_none(tmp_path):
    assert set(table_of(tmp_path, BIDS).colours) == {1, 2}
    assert set(table_of(tmp_path, FRACTIONS).colours) == {5}


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "found no lines"),
        ("# only a comment\n\n", "found no lines"),
        ("spleen\n", r'line 1: expected a label table .* got "spleen"'),
        ("1,spleen,Milz\n", r"line 1: expected a label table .* column names"),
        ("1 spleen 12 13\n", r"line 1: expected a label table"),
        ("1\tspleen\tGM\n", r"line 1: expected a label table"),
        ("1 spleen\n2 liver 1 2 3 0\n", "line 2: expected a label and its name"),
        ('{"labels": {"tumour": [1, 2], "core": 2}}', "nnU-Net.* regions"),
        ('{"labels": {"liver": "x"}}', 'one label for "liver"'),
        ('{"labels": [1]}', "found none"),
        ("{", "JSON"),
        ("<atlas><label>a</label></atlas>", "index"),
        ("<atlas", "FSL"),
        ("label,colour\n1,#ffffff\n", "a row of column names"),
        ("label,name\n1,spleen\n\n2\n", 'line 4: expected 2 columns, as in the first row, got "2"'),
        (
            "label,name\nx,spleen\n",
            'line 2: expected a whole number from 0 in column label, got "x"',
        ),
        ("label,name\n-1,spleen\n", 'got "-1"'),
        ("label,name\n1.5,spleen\n", 'got "1.5"'),
        ("index\tname\tcolor\n1\tspleen\tred\n", 'line 2: expected a colour as #rrggbb, got "red"'),
        (
            "label,name,r,g,b\n1,spleen,1,2,300\n",
            "line 2: expected red, green and blue from 0 to 255, got 1, 2, 300",
        ),
        ("label,name,r,g,b\n1,spleen,1,2\n", "line 2: expected red, green and blue"),
        ("label,name,r,g,b\n1,spleen,0.1,0.2,2\n", "from 0 to 1, got 0.1, 0.2, 2"),
        ("0 a 0 0 0 0\n1 spleen 256 0 0 0\n", "line 2: expected red, green and blue from 0 to 255"),
        ("0 a 0 0 0 0\n1 spleen\n", 'line 2: expected label, name, red, .* got "1 spleen"'),
        ("1 rib 3 10 20 30\n2 rib 4 9 8 7\n", "colours; separate"),
        ("1 liver 10 20 30\n2 rib 4 9 8 7\n", "colours; separate"),
        ("1 A 0 80 0 0 0\n2 A 1 80 0 0 0\n", "colours; separate"),
        ('0 0 0 0 0 0 0 "a"\n1 spleen 1 2 3 0\n', "line 2: expected label, red, .* as in ITK-SNAP"),
        ("1 (none) 1 2 3 0\n", "expected names of labels, found none"),
        (
            "label,name\n1,a\n2147483648,b\n",
            "line 3: expected a label up to 2147483647, got 2147483648",
        ),
        ("label,name\n1," + 200_000 * "x" + "\n", "line 2: "),
    ],
)
def test_what_is_refused(tmp_path, text, match):
    with refusal(match) as caught:
        table_of(tmp_path, text)
    assert str(caught.value).startswith(str(tmp_path / "table.txt"))


def test_a_label_with_two_names_has_none(tmp_path):
    with pytest.warns(UserWarning, match='1, "spleen" .line 2. and "stomach" .line 4.'):
        table = table_of(tmp_path, "label,name\n1,spleen\n2,liver\n1,stomach\n")
    assert table.names == {2: "liver"}


CARET = (
    '<CaretExtension><VolumeInformation Index="0"><LabelTable><Label Key="819" Red="0.5" '
    'Green="0.2" Blue="0.1" Alpha="1"><![CDATA[hypothalamus]]></Label></LabelTable>'
    "</VolumeInformation></CaretExtension>"
)


@pytest.mark.parametrize("name", ["l.nii.gz", "l.nii", "l.img"])
@pytest.mark.parametrize("code", [0, 30])
def test_names_in_the_header_of_a_nifti(here, name, code):
    kind = nibabel.Nifti1Pair if name == "l.img" else nibabel.Nifti1Image
    file = kind(np.zeros((2, 3, 4), "u1"), np.eye(4))
    nibabel.save(file, "none.nii")
    file.header.extensions.append(nibabel.nifti1.Nifti1Extension(code, CARET.encode()))
    nibabel.save(file, name)
    table = load_label_table(name)
    assert table == LabelTable({819: "hypothalamus"}, {819: (0.5, 0.2, 0.1)})
    assert own_label_table(here / "none.nii") == NO_TABLE
    assert_refused("none.nii", "found none", load_label_table)


@pytest.mark.parametrize(
    "text", [CARET.replace("Key", "Kee"), "<CaretExtension><</CaretExtension>"]
)
def test_a_header_without_readable_names_is_no_obstacle(here, text):
    file = nibabel.Nifti1Image(np.zeros((2, 3, 4), "u1"), np.eye(4))
    file.header.extensions.append(nibabel.nifti1.Nifti1Extension(0, text.encode()))
    nibabel.save(file, "bad.nii")
    with pytest.warns(UserWarning, match="bad.nii.*ignored"):
        assert own_label_table(here / "bad.nii") == NO_TABLE


@pytest.mark.parametrize(
    ("name", "label", "of_label"),
    [
        ("totalsegmentator", 92, "rib_left_1"),
        ("totalsegmentator_v1", 92, "sacrum"),
        ("totalsegmentator_mr", 20, "intervertebral_discs"),
        ("aseg", 2035, "ctx-rh-insula"),
        ("simnibs", 5, "Scalp"),
    ],
)
def test_tables_of_programs(here, name, label, of_label):
    assert load_label_table(name).names[label] == of_label
    (here / name).write_text("1 own\n")
    assert load_label_table(name).names == {1: "own"}


def test_other_files(here):
    assert_refused("none.txt", "no such file", load_label_table)
    assert_refused(here, "got a folder", load_label_table)
    for encoding in ("latin-1", "utf-16"):
        with refusal("expected UTF-8 text"):
            table_of(here, SNAP, encoding=encoding)


# In a mesh's file


def test_a_table_goes_through_json(tmp_path):
    for text in (FREESURFER, SNAP, SLICER, BIDS, FRACTIONS.replace("0.5", "0.2")):
        table = table_of(tmp_path, text)
        again = table_in(json.dumps(table_words(table)))
        assert again.names == table.names
        assert list(again.colours) == sorted(table.colours)
        for label, colour in table.colours.items():
            assert again.colours[label] == pytest.approx(colour, abs=0.002)
    assert table_words(LabelTable({7: "a"}, {7: (1.0, 0.0, 0.2), 5: (0, 0, 0)})) == {
        "5": {"colour": "#000000"},
        "7": {"name": "a", "colour": "#ff0033"},
    }


def test_names_stay_on_one_line():
    assert table_in('{"1": {"name": " a\\n b "}, "2": {"name": " "}}') == LabelTable({1: "a b"}, {})


@pytest.mark.parametrize(
    "text",
    [
        None,
        "",
        "[1]",
        "not json",
        '{"1": 5}',
        '{"' + 5000 * "1" + '": {"name": "a"}}',
        '{"a": {"name": "b"}}',
        '{"1": "b"}',
        9000 * "[",
    ],
)
def test_another_program_s_text_is_no_table(text):
    assert table_in(text) == NO_TABLE


def test_only_some_labels():
    table = LabelTable({1: "a", 2: "b"}, {2: (0.0, 0.0, 0.0), 3: (1.0, 1.0, 1.0)})
    assert table_of_labels(table, [2, 3]) == LabelTable({2: "b"}, {2: (0, 0, 0), 3: (1, 1, 1)})


@pytest.mark.parametrize("text", ["#12345", "123456", "#12345g", None, 5, "#1234567"])
def test_colours_that_are_none(text):
    assert hex_colour(text) is None


# Which label a name means

NAMES = {1: "Spleen", 5: "liver", 6: "left lung", 7: "Rib", 8: "Rib", 9: "lung/right (é)"}


@pytest.mark.parametrize(
    ("text", "labels"),
    [
        ("liver", [5]),
        (" LIVER ", [5]),
        ("spleen", [1]),
        ("left lung", [6]),
        ("left_lung", [6]),
        ("12", [12]),
        ("Rib", [7, 8]),
        ("rib_8", [8]),
        ("lung/right (é)", [9]),
        ("lung_right_e", [9]),
    ],
)
def test_a_name_means_its_labels(text, labels):
    assert labels_named(text, NAMES) == labels


def test_names_that_no_label_has():
    with refusal('label "livre": no label has this name; did you mean liver'):
        labels_named("livre", NAMES)
    with refusal("known names are Spleen, liver, left lung"):
        labels_named("xyzzy", NAMES)
    with refusal("labels have no names; give a table of names"):
        labels_named("liver", {})
    assert label_words(5, NAMES) == "5 (liver)"
    assert label_words(55, NAMES) == "55"


# What their sets are called


def test_names_become_names_of_sets():
    names = {
        1: "left",
        2: "Boundary",
        3: "3rd-Ventricle",
        4: "肝臓",
        5: "label_7",
        6: "label_6",
        7: "interface_1_2",
        8: "material_1",
        9: "a" * 100,
        10: "a" * 99,
        11: "été/(x)",
        12: "Lung",
        13: "lung",
        14: "lung_12",
        15: "",
        16: "all_cells",
    }
    of_label = label_set_names([0, *names], names)
    assert of_label == {
        0: "label_0",
        1: "left_1",
        2: "Boundary_2",
        3: "label_3rd-Ventricle",
        4: "label_4",
        5: "label_7_5",
        6: "label_6",
        7: "label_7",
        8: "material_1_8",
        9: "a" * (MOST_LETTERS - 2) + "_9",
        10: "a" * (MOST_LETTERS - 3) + "_10",
        11: "ete_x",
        12: "label_12",
        13: "lung_13",
        14: "lung_12",
        15: "label_15",
        16: "all_cells_16",
    }
    assert len({name.lower() for name in of_label.values()}) == len(of_label)
    assert all(SET_NAME.fullmatch(name) for name in of_label.values())
    assert label_set_names([12], names) == {12: "label_12"}  # whichever others are there


def test_names_of_interfaces():
    of_label = label_set_names(
        range(7), {1: "a_b", 2: "c", 3: "a", 4: "b_c", 5: "x" * 60, 6: "y" * 40}
    )
    assert interface_names([(0, 1), (1, 2), (3, 4), (2, 3), (5, 6)], of_label) == {
        (0, 1): "interface_0_a_b",
        (1, 2): "interface_1_2",
        (3, 4): "interface_3_4",
        (2, 3): "interface_c_a",
        (5, 6): "interface_5_6",
    }
