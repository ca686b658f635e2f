"""What was asked of a run: options as words and back, and checksums that tell when a run has to
be made again.
"""

from dataclasses import fields
from pathlib import Path

import pytest
import typer
from commands import assert_done, numbers_in

import tetopt
from tetopt import InputError, Job
from tetopt.cli.options import from_records
from tetopt.io.images import sha256
from tetopt.job.option_values import label_sizes_of
from tetopt.job.options import RunOptions, given_options
from tetopt.job.request import checksum, job_request
from tetopt.job.texts import option_words, with_options
from tetopt.model.label_names import LabelTable
from tetopt.start.label_sizes import LabelSize

# Of each field of the options of `tetopt mesh` a value that is not its default.
VALUES = {
    "images": [Path("/a/-b.nii"), Path("/c.nii")],
    "mask": Path("/m.nii"),
    "background": "-5",
    "labels": Path("/l.nii"),
    "weights": "1,2",
    "smooth_interfaces": False,
    "label_weight": 2.0,
    "volume": 1,
    "crop": "1:9,:,:",
    "slice_": "k=3",
    "nodes": 77,
    "target_error": 0.1,
    "nodes_max": 99,
    "size_min": 1.0,
    "edge_size": 9.0,
    "edge_max": 8.0,
    "gradation": 0.5,
    "sizing": Path("/s.nii"),
    "lattice": "octree",
    "uniform": True,
    "spacing": 3.0,
    "start": Path("/m.vtu"),
    "keep_connectivity": True,
    "transform": [Path("/a.mat"), Path("/w.nii")],
    "inverse": True,
    "fixed": Path("/f.nii"),
    "label_field": "tissue",
    "mesh_units": "cm",
    "k_D": 0.3,
    "iterations": 3,
    "boundary": "fixed",
    "method": "paper",
    "shape_power": 2.0,
    "min_dihedral": 5.0,
    "n_t": 2,
    "retessellate": "never",
    "threads": 1,
    "max_seconds": 5.0,
    "max_gb": 3.0,
    "young": "0.5 + 0.01*h",
    "nu": "0.3",
    "density": "1000",
    "fibre": "V1",
    "young_along": "9",
    "shear_along": "2",
    "average": "hill",
    "bins": "5:log",
    "fields": ["mu=/m.nii", "V1=/v.nii:direction@fsl"],
    "sets": ["A=below:1", "B=below:2"],
    "written_sets": "all",
    "loads": ["compress:5%", "hold:xmin"],
    "label_names": Path("/t.csv"),
    "order": 2,
    "nonlinear": True,
    "units": "MPa",
    "space": "lps",
    "written_fields": "mean",
    "keep_components": True,
    "free_volumes": True,
    "keep_labels": "2,liver",
    "fill_holes": "3",
    "drop_labels": "0",
    "cells_across": 1.5,
    "label_size": "1=2",
    "merge": "white=2,41; rest=*",
    "tissues": Path("/c1.nii,/c2.nii"),
    "mask_label": "5,liver",
    "spacing_mm": "0.5",
}


def test_words_give_the_options_back():
    """Every option that runs of many subjects have, as words of a command line, comes to the
    same record.
    """
    before, after = RunOptions(**{each.name: VALUES[each.name] for each in fields(RunOptions)}), []

    def command(options: RunOptions) -> int:
        after.append(options)
        return 0

    app = typer.Typer()
    app.command()(from_records(command))
    app(list(option_words(given_options(before))), standalone_mode=False)
    assert after == [before]


def test_defaults_are_not_given():
    assert given_options(RunOptions()) == {}


@pytest.fixture
def request_of(here):
    """A function from other values of options to what is then requested, of a mesh of an image
    with a mask.
    """
    for name in ("a.nii", "m.nii", "young.csv"):
        Path(name).write_text("intensity,young\n0,1\n100,5\n")

    def request(folder=here, suffix=".vtu", **others):
        options = {"images": folder / "a.nii", "output": folder / f"any{suffix}", "nodes": 50}
        return job_request(Job(**options | {"mask": folder / "m.nii"} | others))

    return request


def test_a_request_states_what_was_given(request_of):
    request = request_of(young="young.csv", nu="0.3")
    assert request["options"] == {"nodes": 50, "nu": "0.3", "format": ".vtu"}
    assert [name for name, _ in request["files"]["images"]] == ["a.nii"]
    assert request_of(labels="m.nii", label_names=Path("aseg"))["options"]["label-names"] == "aseg"
    assert sorted(request["files"]) == ["images", "mask", "young"]
    assert request["tetopt"] == tetopt.__version__


def test_a_request_changes_with_what_decides_the_mesh(request_of):
    first = request_of()["sha256"]
    assert request_of()["sha256"] == request_of(threads=1)["sha256"] == first
    others = [request_of(iterations=3), request_of(suffix=".inp"), request_of(mask=None)]
    Path("m.nii").write_text("another")
    others.append(request_of())
    assert len({first, *(each["sha256"] for each in others)}) == 5


def test_a_table_of_labels_is_part_of_a_request_by_what_it_says(request_of):
    sums = set()
    for size, group in (("1,2", "a,1"), ("1,2.5", "a,1"), ("1,2.5", "bone,1")):
        Path("sizes.csv").write_text(size)
        Path("groups.csv").write_text(group)
        request = request_of(labels="m.nii", label_size="sizes.csv", merge="groups.csv")
        sums.add(request["sha256"])
    assert len(sums) == 3
    assert sorted(request["files"]) == ["images", "label-size", "labels", "mask", "merge"]


def test_sizes_of_labels_in_a_file(tmp_path):
    table = LabelTable({3: "fluid", 4: "bone"}, {})
    file = tmp_path / "sizes.csv"
    for text in (
        "fluid,1.5\nbone,0.6t[1:10]\n*,6\n",
        "name;size_mm;why\nfluid;1.5;thin\nbone;0.6t[1:10];\n*;6;\n",
        "# mm\nLabel,Size\n3, 1.5\n4,0.6t[1:10]\n*,6",
    ):
        file.write_text(text)
        sizes = label_sizes_of(str(file), table)
        assert sizes == {3: LabelSize(1.5), 4: LabelSize(0.6, True, 1.0, 10.0), "*": LabelSize(6.0)}
    for text, match in (
        ("fluid,thin", 'sizes.csv: label_size: expected mm, .* got "thin"'),
        ("fluid,1.5\nbrain,2", 'sizes.csv: label_size: no label has the name "brain"; fluid, bone'),
        ("fluid,1.5\n3,2", "sizes.csv: label_size: label 3 has two sizes"),
        ("fluid", 'sizes.csv: expected rows of a name and values, got "fluid"'),
        ("", "sizes.csv: label_size: expected"),
    ):
        file.write_text(text)
        with pytest.raises(InputError, match=match):
            label_sizes_of(str(file), table)


def test_a_volume_of_a_file_is_part_of_a_request(request_of):
    first, second = (request_of(mask=f"m.nii:{volume}") for volume in (0, 1))
    files = [each["files"]["mask"][0] for each in (first, second, request_of())]
    assert [name for name, _ in files] == ["m.nii:0", "m.nii:1", "m.nii"]
    assert len({checksum for _, checksum in files}) == 1
    assert first["sha256"] != second["sha256"]


def test_a_request_does_not_know_folders(request_of, here):
    other = here / "elsewhere"
    other.mkdir()
    for name in ("a.nii", "m.nii"):
        (other / name).write_bytes(Path(name).read_bytes())
    assert request_of(folder=other) == request_of()


def test_run_json_states_the_request(here):
    """It is the one that the options come to, so that whoever has them knows whether the mesh is
    that one.
    """
    assert_done("phantom sphere -o sphere.nii.gz --voxel-mm 5")
    words = "mesh sphere.nii.gz -o a.vtu --json a.json --nodes 60 --iterations 1 --threads 1"
    assert_done(words)
    job = Job(images="sphere.nii.gz", nodes=60, iterations=1, output="b.vtu")
    assert numbers_in("a.json")["request"] == job_request(job)


def test_options_of_a_row_replace_those_of_all():
    """Of values that may be repeated all are the row's; a switch can be off; what is not named
    stays.
    """
    options = RunOptions(sets=["C=below:3"], nonlinear=True, units="MPa", average="hill")
    texts = {
        "set": "A=below:1; B=below:2;",
        "nonlinear": "No",
        "nodes": "70.0",
        "crop": "1:9,:,:",
        "average": "voigt",
    }
    own = with_options(options, texts)
    assert given_options(own) == {
        "crop": "1:9,:,:",
        "nodes": 70,
        "average": "voigt",
        "set": ["A=below:1", "B=below:2"],
        "units": "MPa",
    }


@pytest.mark.parametrize(
    ("texts", "words"),
    [
        ({"nods": "1"}, "did you mean nodes"),
        ({"nodes": "1.5"}, "`nodes`: expected a whole number, got 1.5"),
        ({"nonlinear": "maybe"}, "expected True or False"),
        ({"iterations": "-1"}, "`iterations`: expected 0 or more"),
        ({"method": "Fast"}, "expected fast or paper, got .Fast."),
        ({"nodes": "9" * 20, "k-d": "x"}, "; `k_D`: expected a number"),
        ({"json": "a.json"}, "not an option"),
        ({"help": "1"}, "not an option"),
    ],
)
def test_options_of_a_row_that_cannot_be(texts, words):
    with pytest.raises(InputError, match=words):
        with_options(RunOptions(), texts)


def test_a_folder_is_read_once_for_its_checksum_and_files_beside_a_header_count(here, monkeypatch):
    reads = []
    monkeypatch.setattr(
        "tetopt.job.request.sha256", lambda path: reads.append(path) or sha256(path)
    )
    folder, header, data = Path("a.zarr"), Path("b.mhd"), Path("b.raw")
    folder.mkdir()
    (folder / "0").write_bytes(b"voxels")
    assert checksum(folder) == checksum(folder) == sha256(folder)
    assert len(reads) == 1
    header.write_text(
        "NDims = 3\nDimSize = 1 1 1\nElementType = MET_UCHAR\nElementDataFile = b.raw\n"
    )
    data.write_bytes(b"1")
    first = checksum(header)
    data.write_bytes(b"22")
    assert checksum(header) == sha256(header) != first
