"""PVTU files: all files of a mesh appear together or not at all; and what strangers may list in one."""

import os
import re
import stat
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import pyvista
from models import sample_model

from tetopt.cli import main
from tetopt.errors import InputError
from tetopt.io import files
from tetopt.io.files import checked_output, outputs_of_command
from tetopt.io.formats import save_model
from tetopt.io.images import sha256
from tetopt.io.meshes import load_mesh
from tetopt.io.pvtu import read_pvtu


def in_parts(n_parts):
    model = sample_model()
    return model._replace(cell_data=model.cell_data | {"part": np.arange(len(model.mesh.cells)) % n_parts})


def all_files(folder):
    """Everything below a folder with its bytes, folders without."""
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


@pytest.fixture
def path(tmp_path):
    save_model(tmp_path / "a.pvtu", in_parts(3))
    return tmp_path / "a.pvtu"


def test_other_readers_see_all_pieces(path):
    model, grid = in_parts(3), pyvista.read(path)
    order = grid.cell_data["GlobalCellIds"]
    np.testing.assert_array_equal(np.sort(order), np.arange(len(model.mesh.cells)))
    np.testing.assert_array_equal(grid.points[grid.cells_dict[10]], model.mesh.points[model.mesh.cells[order]])
    np.testing.assert_array_equal(grid.cell_data["mean"], model.cell_data["mean"][order])
    np.testing.assert_array_equal(grid.field_data["facets:boundary"], model.sets.facets["boundary"])


def test_a_piece_alone_tells_its_axes_and_units(tmp_path):
    save_model(tmp_path / "a.pvtu", in_parts(3), space="lps", units="MPa")
    piece = load_mesh(tmp_path / "a" / "a_2.vtu")
    assert (piece.space, piece.text("units")) == ("lps", "MPa")
    assert len(piece.sets.facets) == 0


def test_the_checksum_is_of_all_files(path):
    """So that a cohort makes a mesh again whose start has changed in a piece alone."""
    before, piece = sha256(path), path.with_suffix("") / "a_2.vtu"
    piece.write_bytes(piece.read_bytes() + b" ")
    assert sha256(path) != before


def test_names_are_escaped(tmp_path):
    path = tmp_path / 'a & <b> "c" é.pvtu'
    save_model(path, in_parts(2))
    root = ElementTree.fromstring(path.read_bytes())
    sources = [each.get("Source") for each in root.iter("Piece")]
    assert sources == [f"{path.stem}/{path.stem}_{k}.vtu" for k in range(2)]
    assert len(load_mesh(path).mesh.cells) == len(sample_model().mesh.cells)


@pytest.mark.parametrize("name", ["a\nb.pvtu", "a\\b.pvtu", "a\udcff.pvtu", "...pvtu"])
def test_names_that_xml_cannot_tell_are_refused(tmp_path, name):
    for call in (lambda: checked_output(tmp_path / name, (".pvtu",)), lambda: save_model(tmp_path / name, in_parts(2))):
        with pytest.raises(InputError, match="takes printable letters"):
            call()
    assert list(tmp_path.iterdir()) == []


# Whole or not at all


def test_both_are_replaced_by_force_alone(path):
    before = all_files(path.parent)
    with pytest.raises(InputError, match="exists already"):
        checked_output(path, (".pvtu",))
    path.unlink()
    with pytest.raises(InputError, match=r"a: exists already, where the pieces of .*a\.pvtu go; pass `force`"):
        checked_output(path, (".pvtu",))
    path.write_bytes(before["a.pvtu"])
    os.chmod(path, 0o600)
    os.chmod(path.with_suffix(""), 0o700)
    checked_output(path, (".pvtu",), force=True)
    save_model(path, in_parts(2))
    assert set(all_files(path.parent)) == {"a", "a.pvtu", "a/a_0.vtu", "a/a_1.vtu"}
    assert {stat.S_IMODE(each.stat().st_mode) for each in (path, *path.with_suffix("").iterdir())} == {0o600}
    assert stat.S_IMODE(path.with_suffix("").stat().st_mode) == 0o700
    assert len(load_mesh(path).mesh.cells) == len(sample_model().mesh.cells)


def test_a_new_one_has_the_rights_of_the_umask(tmp_path):
    mask = os.umask(0o027)
    try:
        save_model(tmp_path / "a.pvtu", in_parts(2))
    finally:
        os.umask(mask)
    modes = {name: stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ("a", "a.pvtu", "a/a_1.vtu")}
    assert modes == {"a": 0o750, "a.pvtu": 0o640, "a/a_1.vtu": 0o640}


@pytest.mark.parametrize("name", ["b.vtu", "a_1.vtu.gz", "a_x.vtu", "a_7.vtu/"])
def test_a_folder_with_anything_else_is_never_replaced(path, name):
    stranger = path.with_suffix("") / name
    stranger.mkdir() if name.endswith("/") else stranger.write_text("precious")
    with pytest.raises(InputError, match=re.escape(f"holds {stranger.name}, which is no piece")):
        checked_output(path, (".pvtu",), force=True)
    assert stranger.exists()


def test_a_file_in_the_folder_s_place_and_links_are_refused(path, tmp_path):
    (tmp_path / "b").write_text("precious")
    with pytest.raises(InputError, match="b: expected a folder of pieces to replace"):
        checked_output(tmp_path / "b.pvtu", (".pvtu",), force=True)
    (tmp_path / "c").symlink_to(tmp_path / "a")
    with pytest.raises(InputError, match="c: expected a folder of pieces to replace"):
        checked_output(tmp_path / "c.pvtu", (".pvtu",), force=True)
    (tmp_path / "d.pvtu").symlink_to(path)
    with pytest.raises(InputError, match="is a link, beside which"):
        checked_output(tmp_path / "d.pvtu", (".pvtu",), force=True)


def test_an_input_among_the_pieces_stays(path, capfd):
    before = all_files(path.parent)
    assert main(["convert", str(path.with_suffix("") / "a_0.vtu"), str(path), "--force"]) == 2
    assert "would replace a folder with an input of this command" in " ".join(capfd.readouterr().err.split())
    assert all_files(path.parent) == before


@pytest.mark.parametrize("has_old", [True, False])
def test_wherever_a_step_fails_there_is_the_old_mesh_or_none(tmp_path, monkeypatch, has_old):
    """Each renaming, synchronisation and change of rights fails once, by number, until a run has fewer."""
    path = tmp_path / "a.pvtu"
    if has_old:
        save_model(path, in_parts(3))
    before, n_faults = all_files(tmp_path), 0
    while True:
        steps = iter(range(1000))

        def faulty(function, steps=steps, fault=n_faults):
            def call(*arguments, **options):
                if next(steps) == fault:
                    raise OSError(28, "No space left on device")
                return function(*arguments, **options)

            return call

        with monkeypatch.context() as patch:
            for name in ("rename", "replace", "fsync", "chmod"):
                patch.setattr(files.os, name, faulty(getattr(os, name)))
            patch.setattr(Path, "write_bytes", faulty(Path.write_bytes))
            try:
                save_model(path, in_parts(2))
                break
            except OSError as error:
                assert "cannot be written" in str(error)  # noqa: PT017 - the last run has none
        assert all_files(tmp_path) == before, n_faults
        n_faults += 1
    assert n_faults > 8
    assert set(all_files(tmp_path)) == {"a", "a.pvtu", "a/a_0.vtu", "a/a_1.vtu"}


def test_another_program_s_files_stay(tmp_path):
    with outputs_of_command():
        path = checked_output(tmp_path / "a.pvtu", (".pvtu",))
        (tmp_path / "a").mkdir()
        (tmp_path / "a" / "a_0.vtu").write_text("another's")
        before = all_files(tmp_path)
        with pytest.raises(InputError, match="another program has written it in the meantime"):
            save_model(path, in_parts(2))
    assert all_files(tmp_path) == before


def test_cohorts_have_one_file_a_subject(tmp_path, capfd):
    (tmp_path / "t.tsv").write_text("subject\timage\na\ta.nii\n")
    assert main(["cohort", str(tmp_path / "t.tsv"), "-o", str(tmp_path / "out"), "--format", ".pvtu"]) == 2
    assert "a subject's mesh is one file, .pvtu is several" in " ".join(capfd.readouterr().err.split())


# Strangers' files


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("../b.vtu", "pieces beside the file, or in folders there"),
        ("a/../../b.vtu", "pieces beside the file"),
        ("/etc/b.vtu", "pieces beside the file"),
        ("C:\\b.vtu", "pieces beside the file"),
        ("http://example.org/b.vtu", "pieces beside the file"),
        ("file:/b.vtu", "pieces beside the file"),
        ("./b.vtu", "pieces beside the file"),
        ("", "pieces beside the file"),
        ("b.vtk", "expected pieces named .vtu"),
        ("a/a_9.vtu", "a_9.vtu: no such file"),
        ("a/a_1.vtu", "lists a piece twice"),
        ("p.vtu", "expected a regular file, got a pipe"),
        ("empty.vtu", "piece empty.vtu: damaged: the file is empty"),
    ],
)
def test_pieces_elsewhere_are_refused(path, source, words):
    os.mkfifo(path.parent / "p.vtu")
    (path.parent / "empty.vtu").write_bytes(b"")
    path.write_text(path.read_text().replace("a/a_0.vtu", source))
    with pytest.raises(InputError, match=words) as caught:
        read_pvtu(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<!DOCTYPE x [<!ENTITY a 'b'>]><VTKFile/>", "document type or entities"),
        ("<VTKFile type='PImageData'><Piece Source='a.vtu'/></VTKFile>", "found PImageData"),
        ("<html type='PUnstructuredGrid'/>", "found another"),
        ("<VTKFile type='PUnstructuredGrid'/>", "found 0"),
        ("<VTKFile type='PUnstructuredGrid'>", "damaged, or not a VTK mesh"),
    ],
)
def test_masters_of_another_kind_are_refused(tmp_path, text, words):
    (tmp_path / "a.pvtu").write_text(text)
    with pytest.raises(InputError, match=words):
        load_mesh(tmp_path / "a.pvtu")


def test_a_damaged_piece_is_named(path):
    piece = path.with_suffix("") / "a_1.vtu"
    piece.write_bytes(piece.read_bytes()[:-300])
    with pytest.raises(InputError, match=r"a\.pvtu: piece a/a_1\.vtu: damaged"):
        load_mesh(path)
