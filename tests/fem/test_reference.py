"""The voxel grid's solution: against scikit-fem, against closed forms, and against fine
tetrahedral meshes.
"""

from itertools import product

import naive
import numpy as np
import pytest
import skfem
from meshes import random_affine
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusal
from shapes import grid
from skfem.models.elasticity import lame_parameters, linear_elasticity

import tetopt
from tetopt.fem.elasticity import box_faces, compression
from tetopt.fem.hexahedra import element_stiffness
from tetopt.fem.reference import (
    OwnError,
    Reference,
    at_centres,
    average_voxels,
    compare,
    interpolate_nodes,
    near_interface,
    nearest,
    reference,
    reference_shape,
    refine_voxels,
)
from tetopt.geometry.quadratic import quadratic

SHEARED = np.array([[1.5, 0.3, -0.2], [0.1, 2.0, 0.4], [0.2, -0.3, 0.8]])


def affine_of(linear, shift):
    n = len(linear)
    affine = np.eye(n + 1)
    affine[:n, :n], affine[:n, n] = linear, shift
    return affine


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.49])
def test_element_against_scikit_fem(nu):
    """One sheared hexahedron, corner by corner."""
    corners = np.array(list(product((0.0, 1.0), repeat=3)))
    points = corners @ SHEARED.T
    mesh = skfem.MeshHex().translated((0.0, 0.0, 0.0))
    order = [int(np.flatnonzero((corners == p).all(axis=1))[0]) for p in mesh.p.T]
    mesh = skfem.MeshHex(points[order].T, mesh.t)
    basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementHex1()), intorder=4)
    K = linear_elasticity(*lame_parameters(1.0, nu)).assemble(basis).toarray()
    ours = element_stiffness(SHEARED, nu)
    dof = basis.nodal_dofs  # (3, 8)
    for a, b in product(range(8), repeat=2):
        assert_allclose(ours[order[a], order[b]], K[np.ix_(dof[:, a], dof[:, b])], atol=1e-12)


@pytest.mark.parametrize("flip", [1.0, -1.0])
def test_bar_without_sideways_strain(n, flip):
    """nu = 0: u is linear along the push, E_strain = 1/2 E strain^2 V; the top rests, whichever
    way the axis runs.
    """
    linear = np.diag([1.5, 2.0, 0.5][3 - n :])
    linear[-1, -1] *= flip
    image = tetopt.Image(np.full((4, 3, 5)[:n], 7.0), affine_of(linear, 3.0))
    exact = reference(image, 0.0, percent=2.0)
    assert exact.strain_energy == pytest.approx(0.5 * 7.0 * 0.02**2 * image.volume, rel=1e-9)
    expected = np.zeros((n, n))
    expected[-1, -1] = -0.02
    u, strain = at_centres(image, exact.u, np.arange(image.data.size))
    assert_allclose(strain, np.broadcast_to(expected, strain.shape), atol=1e-9)
    assert_allclose(exact.u, exact.u_homogeneous, atol=1e-9)
    assert exact.own_error.strain_energy < 1e-9
    assert exact.own_error.displacement is None
    assert exact.n_dofs == np.prod(np.array(image.shape) + 1) * n
    along = image.to_world(grid(image.shape).reshape(-1, n))[:, -1]
    top = along.max() + 0.5 * abs(linear[-1, -1])
    assert_allclose(u[:, -1], 0.02 * (top - along), atol=1e-9)


def linear_reference(image, slope, shift):
    """A made-up solution u = slope x + shift, against 0 for the homogeneous block."""
    nodes = grid(np.array(image.shape) + 1) - 0.5
    u = image.to_world(nodes.reshape(-1, image.ndim)).reshape(nodes.shape) @ slope.T + shift
    return Reference(image, 0.3, 2.0, u, np.zeros_like(u), OwnError(0.0, None), 0)


def known_field(shape, affine=None, seed=0):
    """A mesh, a linear field at its nodes and in voxels, and labels of two slabs."""
    rng = np.random.default_rng(seed)
    image = tetopt.Image(rng.uniform(1.0, 2.0, shape), affine)
    mesh = tetopt.lattice_mesh(image, nodes=60)
    slope, shift = rng.normal(size=(3, 3)), rng.normal(size=3)
    labels = np.zeros(shape)
    labels[:3] = 1
    exact = linear_reference(image, slope, shift)
    return mesh, mesh.points @ slope.T + shift, exact, labels


def test_errors_of_a_known_field():
    """The same linear field on the mesh has no error; one scaled by 1.1 has 0.1 in displacement
    and strain.
    """
    mesh, u, exact, labels = known_field((7, 6, 5), affine_of(SHEARED, 4.0))
    assert_allclose(compare(exact, mesh, u, 2.0, labels), 0.0, atol=1e-12)
    assert_allclose(compare(exact, mesh, 1.1 * u, 1.8, labels), 0.1, rtol=1e-9)
    assert compare(exact, mesh, u, 2.0, np.zeros(labels.shape)).interface_strain is None


def test_errors_of_quadratic_cells(n):
    """A quadratic field is that of cells of order 2: its error against itself is what the voxels
    leave out of it.
    """
    rng = np.random.default_rng(n)
    image = tetopt.Image(np.ones((9, 8, 7)[:n]), affine_of(SHEARED[:n, :n], 4.0))
    mesh = tetopt.lattice_mesh(image, nodes=60)
    bend = rng.normal(size=(n, n, n))

    def field(x):
        return np.einsum("...i,dij,...j->...d", x, bend, x)

    nodes = grid(np.array(image.shape) + 1) - 0.5
    exact = linear_reference(image, np.zeros((n, n)), np.zeros(n))
    exact.u[:] = field(image.to_world(nodes.reshape(-1, n))).reshape(nodes.shape)
    labels = np.zeros(image.shape)
    labels[:4] = 1
    u = field(quadratic(mesh.points, mesh.cells)[0])
    errors = compare(exact, mesh, u, 2.0, labels)
    # The mean of a voxel's corners is above a quadratic at its centre by a constant; the slope is
    # the same.
    corners = np.array(list(product((-0.5, 0.5), repeat=n))) @ SHEARED[:n, :n].T
    excess = field(corners).mean(axis=0)
    there = at_centres(image, exact.u, np.arange(image.data.size))[0]
    assert errors.displacement == pytest.approx(
        np.linalg.norm(excess) / np.sqrt((there**2).sum(axis=1).mean())
    )
    assert errors.interface_strain == pytest.approx(0.0, abs=1e-12)
    linear = compare(exact, mesh, field(mesh.points), 2.0, labels)
    assert linear.interface_strain > 0.1


def test_near_interface_by_brute_force():
    rng = np.random.default_rng(3)
    labels = np.zeros((9, 8, 7), dtype=int)
    labels[2:4, 3, 2:5] = 1
    labels[7:, 6:, :] = 2
    is_near = near_interface(labels)
    edges = []
    for voxel in np.ndindex(*labels.shape):
        for axis in range(3):
            for step in (-1, 1):
                other = list(voxel)
                other[axis] += step
                if 0 <= other[axis] < labels.shape[axis] and labels[tuple(other)] != labels[voxel]:
                    edges.append(voxel)
    edges = np.array(edges)
    for voxel in rng.permutation(list(np.ndindex(*labels.shape)))[:200]:
        assert is_near[tuple(voxel)] == (np.linalg.norm(edges - voxel, axis=1).min() <= 1.5)


@pytest.mark.parametrize("shape", [(7, 10, 9), (5, 1, 6)])
def test_averaged_against_exact_fractions(shape):
    """Cut voxels count by the part of them; the box stays the same."""
    image = tetopt.Image(np.random.default_rng(6).normal(size=shape), affine_of(SHEARED, 2.0))
    for new in (tuple((s + 1) // 2 for s in shape), tuple(max(1, s - 2) for s in shape)):
        coarse = average_voxels(image, new)
        assert_allclose(coarse.data, naive.block_means(image.data, new), atol=1e-13)
        for corner in product((0, 1), repeat=3):
            ends = [np.where(corner, np.array(i.shape) - 0.5, -0.5) for i in (image, coarse)]
            assert_allclose(image.to_world(ends[0]), coarse.to_world(ends[1]), atol=1e-12)
    assert_array_equal(average_voxels(image, shape).data, image.data)


@pytest.mark.parametrize(("old", "new"), [((3, 5, 4), (7, 10, 4)), ((2, 1), (4, 3))])
def test_interpolated_against_dense_interpolation(old, new):
    u = np.random.default_rng(7).normal(size=(*(s + 1 for s in old), len(old)))
    P = [naive.interpolation(*pair) for pair in zip(new, old, strict=True)]
    axes = "abc"[: len(old)], "ijk"[: len(old)]
    dense = np.einsum(
        f"{','.join(map(''.join, zip(*axes, strict=True)))},{axes[1]}d->{axes[0]}d", *P, u
    )
    assert_allclose(interpolate_nodes(u, new), dense, atol=1e-14)


def test_reference_shape_is_as_fine_as_allowed():
    """No more dofs than allowed, no finer than the image, nearly cubic."""
    for shape, spacing, dofs in (
        ((60, 50, 40), (1.0, 1.0, 1.0), 30_000),
        ((200, 180, 20), (0.5, 0.5, 5.0), 90_000),
    ):
        coarse = reference_shape(shape, np.array(spacing), dofs)
        assert 3 * np.prod(np.array(coarse) + 1) <= dofs
        assert all(c <= s for c, s in zip(coarse, shape, strict=True))
        assert 3 * np.prod(np.array(coarse) + 1) > 0.7 * dofs
    assert reference_shape((9, 8, 7), np.ones(3), 10**9) == (9, 8, 7)


def test_nearest_takes_the_voxel_around_the_centre():
    image = tetopt.Image(np.arange(6.0).reshape(3, 2))
    fine = tetopt.Image(np.zeros((9, 4)), np.diag([1 / 3, 1 / 2, 1.0]))
    assert_array_equal(nearest(image, fine).data, image.data.repeat(3, axis=0).repeat(2, axis=1))
    image = tetopt.Image(np.arange(8.0)[:, None] * np.ones((1, 6)))
    assert_array_equal(nearest(image, tetopt.Image(np.zeros((2, 3)))).data[:, 0], [2.0, 6.0])


def test_refined_is_the_same_field():
    """Every voxel is divided evenly, so that the mean stays; the box, and what a place in it
    holds, are the same.
    """
    image = tetopt.Image(
        np.random.default_rng(3).uniform(size=(5, 4, 3)), random_affine(np.random.default_rng(4), 3)
    )
    fine = refine_voxels(image, (11, 4, 8))
    assert fine.shape == (10, 4, 9)
    assert fine.data.mean() == pytest.approx(image.data.mean(), rel=1e-12)
    of = np.rint(image.to_index(fine.to_world(grid(fine.shape).reshape(-1, 3)))).astype(int)
    assert_array_equal(fine.data.ravel(), image.data[tuple(of.T)])
    assert_array_equal(refine_voxels(image, image.shape).data, image.data)


@pytest.mark.full
def test_own_error_is_that_of_half_the_resolution():
    """Energy and displacement of a reference on voxels twice as long; the homogeneous block is
    that of one modulus.
    """
    rng = np.random.default_rng(10)
    image = tetopt.Image(rng.uniform(1.0, 10.0, (8, 7, 10)), affine_of(SHEARED, 1.0))
    exact = reference(image, 0.3)
    coarse = reference(average_voxels(image, (4, 3, 5)), 0.3)
    P = [naive.interpolation(*pair) for pair in ((8, 4), (7, 3), (10, 5))]
    difference = np.einsum("ai,bj,ck,ijkd->abcd", *P, coarse.u) - exact.u
    even = reference(tetopt.Image(np.ones(image.shape), image.affine), 0.3).u
    assert_array_equal(exact.u_homogeneous, even)
    assert exact.own_error.strain_energy == pytest.approx(
        abs(coarse.strain_energy / exact.strain_energy - 1.0)
    )
    scale = np.linalg.norm(exact.u - even)
    assert exact.own_error.displacement == pytest.approx(
        np.linalg.norm(difference) / scale, rel=1e-9
    )
    assert exact.own_error.displacement > 0.01


def test_homogeneous_block_has_no_displacement_error():
    image = tetopt.Image(np.full((6, 5, 4), 3.0))
    mesh = tetopt.lattice_mesh(image, nodes=40)
    bottom, top = box_faces(image, mesh)
    exact = reference(image, 0.3)
    pressed = compression(
        mesh, 3.0, 0.3, fixed_nodes=top, pushed_nodes=bottom, displacement=[0.0, 0.0, 0.04]
    )
    errors = compare(exact, mesh, pressed.u, pressed.strain_energy, np.zeros(image.shape))
    assert errors.displacement is None
    assert errors.interface_strain is None


def test_errors_are_relative_to_what_the_image_does():
    """Displacement over what sets it apart from the homogeneous one; strain over that near the
    interfaces alone.
    """
    mesh, u, exact, labels = known_field((12, 6, 5), seed=4)
    exact = exact._replace(u_homogeneous=0.5 * exact.u)
    errors = compare(exact, mesh, np.zeros_like(u), 2.0, labels)
    assert errors.displacement == pytest.approx(2.0)
    assert errors.interface_strain == pytest.approx(1.0)
    exact.u[8:] *= 5.0  # far from the interface
    errors = compare(exact, mesh, u, 2.0, labels)
    assert errors.displacement > 0.5
    assert errors.interface_strain == pytest.approx(0.0, abs=1e-12)


def test_work_is_done_in_pieces(monkeypatch):
    """However many voxels are compared at once, the errors are the same."""
    mesh, u, exact, labels = known_field((7, 6, 5), affine_of(SHEARED, 4.0), 9)
    u = np.random.default_rng(9).normal(size=u.shape)
    whole = compare(exact, mesh, u, 2.0, labels)
    monkeypatch.setattr("tetopt.fem.reference.VOXELS_AT_ONCE", 17)
    assert_allclose(compare(exact, mesh, u, 2.0, labels), whole, rtol=1e-12)


def test_refuses_a_modulus_of_0():
    image = tetopt.Image(np.where(np.arange(8).reshape(2, 2, 2) == 3, 0.0, 1.0))
    with refusal("above 0 kPa"):
        reference(image, 0.3)
