"""One test per figure and table row of the paper; the printed numbers are in
`scripts/paper/paper.toml`.

Tolerances are the printed digits where the paper says how the mesh was made (row 3), and a band
where it does not; each band is justified in a line. Counts are compared in
`test_reproduce_paper.py`.
"""

import functools

import numpy as np
import pytest
from numpy.testing import assert_allclose
from paper import experiments as paper

import tetopt
from tetopt.geometry.topology import largest_component

PRINTED = paper.printed_numbers()["table1"]


def errors(name):
    return np.array(PRINTED[name]["errors"])


figure_2, figure_3cd = map(functools.cache, (paper.figure_2, paper.figure_3cd))


@pytest.fixture(scope="module")
def brain(data_dir):
    return tetopt.load_image(data_dir / "mni_icbm152_t1_tal_nlin_sym_09a_converted.nii.gz")


@pytest.fixture(scope="module")
def case_3ef(brain):
    return paper.figure_3ef(brain)


def E_D_left(case):
    return case.result.history[-1].E_D / case.result.history[0].E_D


@pytest.mark.full
def test_row_1_and_2_random_nodes():
    """Fig. 1, 8 seeds. The paper shows one draw, made in a way it does not tell.

    Bands: the printed values of (i), (iii) and (iv) lie within a factor of 1.4 of the medians;
    (ii), which one almost regular cell pulls to 0, only has to fall as printed.
    """
    spread = paper.figure_1_spread(8)
    for name in ("fig1a", "fig1b"):
        ratio = (np.median(spread[name], axis=0)[:4] / errors(name))[[0, 2, 3]]
        assert np.abs(np.log(ratio)).max() < np.log(1.4), name
    # Every measure improves on every seed but the harmonic mean, which improves on most.
    improved = spread["fig1b"] < spread["fig1a"]
    assert improved[:, [0, 2, 3]].all()
    assert improved[:, 1].mean() > 0.8


def test_geometric_mean_of_other_rows():
    """Nearer to the printed column than the harmonic mean is, in every row whose mesh is optimised.

    Band: within a factor of 1.4 of the printed one, as the other measures of random meshes.
    """
    meshes = {"fig2c": figure_2(0.05), "fig2d": figure_2(0.30), "fig3d": figure_3cd(30.0)}
    for name, case in meshes.items():
        mesh = case.result.mesh
        means = paper.geometric_mean_error(mesh), paper.errors_of(mesh).harmonic_mean
        geometric, harmonic = np.abs(np.log(means / errors(name)[1]))
        assert geometric < min(np.log(1.4), harmonic), name


def test_figure_1c_energy_falls_and_nodes_stop():
    case = paper.figure_1(0)
    E = [row.E for row in case.result.history]
    assert E == sorted(E, reverse=True)
    assert case.result.ended == "converged"
    assert len(case.initial.points) == 61


def test_row_3_to_the_printed_digits():
    """Fig. 2(a) is fully known: 7 x 7 squares cut into four."""
    ours = paper.errors_of(figure_2(0.05).initial)
    assert_allclose(ours, errors("fig2a"), rtol=0.0, atol=0.5e-4)


@pytest.mark.parametrize(("k_D", "name"), [(0.05, "fig2c"), (0.30, "fig2d")])
def test_rows_4_and_5(k_D, name):
    """Fig. 2(c, d) on our own phantom. "All measures, except for the worst element error, were
    improved".

    Bands: (i) within 20 % of the printed value; it is set by the number of inclusions a mesh has to
    follow, which is about the same. (iii) and (iv) hang on a few cells at the inclusions' corners:
    only below the initial (iii), and for k_D = 0.05 below twice the printed (iv).
    """
    ours, initial = np.array(paper.errors_of(figure_2(k_D).result.mesh)), errors("fig2a")
    assert np.all(ours[:3] < initial[:3])
    assert ours[3] > initial[3]
    assert ours[0] == pytest.approx(errors(name)[0], rel=0.2)
    if k_D == 0.05:
        assert ours[3] < 2.0 * errors(name)[3]


def test_more_weight_fits_the_phantom_better():
    """Fig. 2(c) against (d): E_D falls with k_D, and the mean error (i) rises as it does in the
    table.
    """
    low, high = figure_2(0.05), figure_2(0.30)
    assert high.result.history[-1].E_D < 0.5 * low.result.history[-1].E_D
    assert paper.errors_of(high.result.mesh).mean > paper.errors_of(low.result.mesh).mean


@pytest.mark.parametrize("k_D", [0.05, 0.3])
def test_figure_2b_descent_finds_the_lowest_place(k_D):
    """The minimum that the descent finds is as low as any on a grid over the landscape, to a
    hundredth of its depth.
    """
    landscape = paper.figure_2b(k_D, n_places=21)
    assert landscape.E_minimum < landscape.E.min() + 0.01 * np.ptp(landscape.E)
    assert landscape.E[10, 10] == pytest.approx(1.0, abs=0.01)


def test_figure_2b_moves_from_the_middle_to_the_edge():
    """The priority passes from shape to image: the further from the middle the larger k_D."""
    away = [
        np.linalg.norm(paper.figure_2b(k_D, n_places=3).minimum - 29.5)
        for k_D in (0.0, 0.05, 0.3, 0.8)
    ]
    assert away == sorted(away)
    assert away[0] < 1e-3
    assert away[3] > 10.0


@pytest.mark.full
def test_figure_3ab_brain_slice(brain):
    """128 nodes and 224 triangles; "a substantial improvement in the representation".

    Band: E_D below 0.6 of the initial's on the MNI T1, brain only as in the paper's picture.
    """
    assert E_D_left(paper.figure_3ab(brain)) < 0.6


def test_row_6_elastography_mesh():
    """Fig. 3(c): 113 nodes, 196 triangles. The printed errors are those of a box 2 % longer than
    wide.

    Band: the printed mean, 0.0859, is squares' within 0.0002; the worst, 0.0922, is not, which
    gives the aspect.
    """
    assert paper.errors_of(figure_3cd(30.0).initial).mean == pytest.approx(
        errors("fig3c")[0], abs=2e-4
    )
    box = tetopt.Image(np.zeros((100, 102)) + np.arange(102))
    longer = paper.errors_of(tetopt.lattice_mesh(box, blocks=(7, 7)))
    assert longer.worst == pytest.approx(errors("fig3c")[3], abs=2e-3)


@pytest.mark.parametrize("snr", [None, 30.0, 20.0])
def test_row_7_elastography_optimised(snr):
    """Fig. 3(d) on simulated data. Band: (i), (iii) within 20 % of the printed values at every
    noise level, since the gland and its nodules take up as much of the mesh as the paper's; the
    worst cell within a factor of 1.6.
    """
    ratio = paper.errors_of(figure_3cd(snr).result.mesh) / errors("fig3d")
    assert_allclose(ratio[[0, 2]], 1.0, rtol=0.2)
    assert 1 / 1.6 < ratio[3] < 1.6


def test_elastography_recovers_the_stiffness():
    """1 / strain shows the nodules brighter than the gland, and the gland brighter than its
    surroundings.
    """
    truth = tetopt.load_phantom("prostate_2d").image().data
    modulus = paper.elastography(30.0).data
    means = [modulus[truth == kPa].mean() for kPa in (10.0, 20.0, 45.0, 60.0)]
    assert means == sorted(means)
    assert means[3] > 2.0 * means[1] > 2.5 * means[0]


@pytest.mark.parametrize("snr", [None, 30.0, 20.0])
def test_conditioning_and_strain_energy(snr):
    """Section 3: +16 % lambda_max, +7 % cond, -5 % strain energy on the paper's prostate.

    Direction and band: both conditioning numbers rise, by less than a factor of 2, "within
    acceptable range"; the strain energy falls, by less than a tenth. Our phantom has sharper
    contrasts, so its cells deform more.
    """
    case = figure_3cd(snr)
    before, after = (
        paper.simulate(case.image, mesh)[0] for mesh in (case.initial, case.result.mesh)
    )
    assert 1.0 < after.lambda_max / before.lambda_max < 2.0
    assert 1.0 < after.cond / before.cond < 2.0
    assert 0.9 < after.strain_energy / before.strain_energy < 1.0


@pytest.mark.full
def test_figure_3e_volume(case_3ef):
    """1078 nodes and 3900 tetrahedra, 13 x 10 x 6 cubes of five; the optimised mesh fits the
    volume better.
    """
    assert E_D_left(case_3ef) < 0.7
    volume = case_3ef.result.mesh.cell_volumes.sum()
    assert volume == pytest.approx(case_3ef.image.volume, rel=1e-12)


@pytest.mark.full
def test_figure_3f_ventricles(case_3ef):
    """The largest connected set of tetrahedra under a threshold is the lateral ventricles: on both
    sides of the middle plane, above the anterior commissure (the MNI origin), where the tissue
    labels have CSF.
    """
    mesh, h = case_3ef.result.mesh, case_3ef.image.data
    is_dark = tetopt.cell_moments(case_3ef.image, mesh).mean < 0.6 * np.median(h[h > h.mean()])
    inside = largest_component(mesh.cells, is_dark)
    centres, v = mesh.points[mesh.cells[inside]].mean(axis=1), mesh.cell_volumes[inside]
    x, _, z = np.average(centres, axis=0, weights=v)
    assert abs(x) < 3.0
    assert 8.0 < z < 22.0
    assert centres[:, 0].min() < -20.0 < 20.0 < centres[:, 0].max()
    assert 1.5e4 < v.sum() < 4.5e4  # lateral ventricles of the template, widened by cells of 10 mm


def turned(turn, spacing):
    """An affine turned about x."""
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[1, 0, 0, 0], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1.0]])
    return rotation @ np.diag([*spacing, 1.0])


@pytest.mark.parametrize("turn", [0.0, 0.3])
def test_simulate_is_the_compression_it_says(turn):
    """Eq. (2): the mean of the voxels; the high face held, the low one pushed."""
    affine = turned(turn, [2.0, 1.0, 1.5])
    image = tetopt.Image(np.random.default_rng(1).uniform(1.0, 5.0, (6, 9, 8)), affine)
    mesh = tetopt.lattice_mesh(image, nodes=60)
    simulated, pressed = paper.simulate(image, mesh)
    owner = tetopt.cell_of_voxel(image, mesh).ravel()
    n_voxels = np.bincount(owner, minlength=len(mesh.cells))
    has_voxels = n_voxels > 0
    sums = np.bincount(owner, weights=image.data.ravel(), minlength=len(mesh.cells))
    assert_allclose(simulated.young[has_voxels], sums[has_voxels] / n_voxels[has_voxels])
    k = image.to_index(mesh.points)[:, 2]
    assert_allclose(pressed.u[k > 7.4], 0.0, atol=1e-12)
    low = pressed.u[k < -0.4]
    assert_allclose(low, np.tile(0.01 * 12.0 * affine[:3, 2] / 1.5, (len(low), 1)), atol=1e-12)


def test_turning_the_world_changes_nothing():
    """A body pressed along its own axis: the energy is the same however it lies in the scanner."""
    data = np.random.default_rng(2).uniform(1.0, 5.0, (6, 5, 7))
    energies = []
    for turn in (0.0, 0.7):
        image = tetopt.Image(data, turned(turn, [1.0] * 3))
        mesh = tetopt.lattice_mesh(image, blocks=(3, 3, 3))
        energies.append(paper.simulate(image, mesh)[0].strain_energy)
    assert_allclose(energies, energies[0], rtol=1e-9)
