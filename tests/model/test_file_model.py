"""A model of what `tetopt.load_mesh` reads: all that the file has goes on."""

import numpy as np
import pytest
from models import quadratic_model, sample_model

import tetopt
from tetopt.cli import main
from tetopt.model.label_names import colour_labels, table_words

TABLE = tetopt.LabelTable({0: "white matter", 1: "skull"}, {1: (1.0, 0.0, 0.0)})


def saved(folder, model, name="a.vtu"):
    tetopt.save_model(folder / name, model)
    return tetopt.load_mesh(folder / name)


def named(model):
    """The model with a table of its labels and sets by their names."""
    about = {"label_table": TABLE, "image": "T1.nii.gz"}
    again = tetopt.build_model(
        model.mesh,
        young=3.0 + np.arange(len(model.mesh.cells)) % 2,
        nu=0.3,
        density=1100.0,
        order=model.order,
        cell_data=model.cell_data,
        about=about,
        sets=["tip=below:20"],
        loads=["hold:inferior", "pressure:superior:2"],
    )
    return again._replace(point_data=model.point_data)


@pytest.mark.parametrize("model", [sample_model(), quadratic_model()])
def test_what_the_file_has_goes_on(tmp_path, model):
    first = named(model)
    again = tetopt.build_model(saved(tmp_path, first))
    assert again.order == first.order
    assert again.loads[0]._replace(numbers=None) == first.loads[0]._replace(numbers=None)
    assert [load.numbers.tolist() for load in again.loads] == [
        load.numbers.tolist() for load in first.loads
    ]
    for one, other in zip(again.sets, first.sets, strict=True):
        assert list(one) == list(other)
        assert all(one[name].tolist() == other[name].tolist() for name in one)
    assert "label_skull" not in again.sets.cells
    assert "skull" in again.sets.cells
    for name in ("young", "nu", "density"):
        values = [getattr(each.materials, name)[each.materials.of_cell] for each in (again, first)]
        assert (values[0] == values[1]).all()
    assert {name: values.tolist() for name, values in again.cell_data.items()} == {
        name: values.tolist() for name, values in first.cell_data.items()
    }
    assert again.point_data.keys() >= first.point_data.keys()
    assert again.about["image"] == "T1.nii.gz"
    assert again.about["label_table"] == table_words(colour_labels(TABLE, np.array([0])))


def test_what_is_stated_takes_the_place_of_the_file_s(tmp_path):
    loaded = saved(tmp_path, named(sample_model()))
    by_name = tetopt.build_model(loaded, young="skull=90,white_matter=2", loads=["hold:inferior"])
    assert set(by_name.materials.young.tolist()) == {2.0, 90.0}
    assert by_name.materials.density is None
    assert len(by_name.loads) == 1
    assert by_name.order == 1
    assert tetopt.build_model(loaded, nu=0.4).materials.young.tolist() == [3.0, 4.0]
    solved = tetopt.solution_fields(loaded.mesh, tetopt.solve(tetopt.build_model(loaded)))
    painted = loaded._replace(
        cell_data=loaded.cell_data | solved.cell_data, point_data=solved.point_data
    )
    assert "von_mises" in tetopt.build_model(painted).cell_data
    assert "displacement" not in tetopt.build_model(painted, young=2.0).point_data
    assert "von_mises" not in tetopt.build_model(painted, young=2.0).cell_data


def test_loads_whose_sets_are_gone_are_said_to_be_left_out(tmp_path):
    loaded = saved(tmp_path, named(sample_model()))
    facets = {name: rows for name, rows in loaded.sets.facets.items() if name != "inferior"}
    with pytest.warns(
        UserWarning, match="dropped the file's loads: it no longer has the sets inferior"
    ):
        assert (
            tetopt.build_model(loaded._replace(sets=loaded.sets._replace(facets=facets))).loads
            == ()
        )


@pytest.mark.full
def test_as_convert_writes_it(tmp_path, monkeypatch):
    """The same file by the command and by the function, but for the version in its head."""
    monkeypatch.chdir(tmp_path)
    loaded = saved(tmp_path, named(sample_model()), "first.vtu")
    assert main(["convert", "first.vtu", "b.inp", "--nu", "0.35"]) == 0
    tetopt.save_model(
        "ours.inp", tetopt.build_model(loaded, nu=0.35, about={"tetopt": tetopt.__version__})
    )
    assert (tmp_path / "ours.inp").read_text("utf-8") == (tmp_path / "b.inp").read_text("utf-8")
