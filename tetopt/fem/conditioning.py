"""Conditioning of the stiffness matrix: its extreme eigenvalues, and iterations of a solver.

Section 3 compares meshes by the largest eigenvalue lambda and the condition number k of their
stiffness matrices. Both refer to the matrix of the free dofs in the solved system, as without
boundary conditions the smallest eigenvalue is 0. So they depend on the boundary conditions, which
must be the same to compare meshes.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, cg, eigsh, lobpcg

from tetopt.errors import InputError
from tetopt.fem.elasticity import (
    RESIDUAL_FRACTION,
    Method,
    System,
    factorize_matrix,
    is_direct,
    multigrid,
    on_one_blas_thread,
)
from tetopt.system.arrays import Floats

# up to which a full matrix is used, as the Lanczos solver needs more dofs than eigenvalues
DENSE_DOFS = 32


class Conditioning(NamedTuple):
    """Result of `conditioning`."""

    lambda_max: float  # largest eigenvalue of K_ff, kPa mm^(n-2)
    lambda_min: float  # smallest eigenvalue, above 0
    cond: float  # their quotient, the 2-norm condition number
    cg_iterations: int  # see `cg_iterations`, for the system's load


@on_one_blas_thread
def conditioning(system: System, *, method: Method = "auto") -> Conditioning:
    """Extreme eigenvalues, condition number and iteration count of a constrained stiffness matrix.

    Parameters
    ----------
    system : System
        From `tetopt.fem.elasticity.constrain_nodes`, or the `system` of a `Compression`.
    method : {"auto", "direct", "amg"}
        Method for the smallest eigenvalue: factorisation, which "auto" uses up to `DIRECT_DOFS`
        free dofs, or LOBPCG preconditioned by multigrid.

    Returns
    -------
    Conditioning
        Eigenvalues with a relative accuracy of 1e-7 or better, and deterministic on any number of
        threads.

    Raises
    ------
    InputError
        Unknown method, or no free dof, as every node is fixed.
    RuntimeError
        An eigenvalue or the solution did not converge.
    """
    if len(system.free) == 0:
        raise InputError(
            "conditioning: every node is fixed or pushed, so there is nothing to solve; use a "
            "finer mesh"
        )
    largest = lambda_max(system.K_ff)
    smallest = lambda_min(system.K_ff, None if is_direct(system, method) else multigrid(system))
    return Conditioning(
        largest, smallest, largest / smallest, cg_iterations(system.K_ff, system.load)
    )


def lambda_max(K_ff: csr_array) -> float:
    """Largest eigenvalue of a symmetric matrix, by Lanczos iterations from a fixed start.

    Raises
    ------
    RuntimeError
        Not converged.
    """
    if K_ff.shape[0] <= DENSE_DOFS:
        return float(np.linalg.eigvalsh(K_ff.toarray())[-1])
    return _by_lanczos(K_ff, "largest", which="LA", tol=1e-10)


def lambda_min(K_ff: csr_array, preconditioner: LinearOperator | None = None) -> float:
    """Smallest eigenvalue of a symmetric positive definite matrix.

    Parameters
    ----------
    K_ff : (F, F) csr_array
    preconditioner : (F, F) LinearOperator, optional
        Approximate inverse of K_ff for LOBPCG, see `tetopt.fem.elasticity.multigrid`. Without it
        K_ff is factorised, and Lanczos iterations find the largest eigenvalue of its inverse.

    Raises
    ------
    RuntimeError
        Not converged.
    """
    if K_ff.shape[0] <= DENSE_DOFS:
        return float(np.linalg.eigvalsh(K_ff.toarray())[0])
    if preconditioner is not None:
        return _by_lobpcg(K_ff, preconditioner)
    return _by_inverse(K_ff, factorize_matrix(K_ff))


def _by_inverse(K_ff: csr_array, solve: Callable[[NDArray], NDArray], tol: float = 0.0) -> float:
    """Smallest eigenvalue by Lanczos on the inverse of K_ff, where each product is a solve;
    `tol` 0 is all digits.
    """
    inverse = LinearOperator(K_ff.shape, matvec=solve, dtype=np.float64)
    return _by_lanczos(K_ff, "smallest", sigma=0.0, OPinv=inverse, tol=tol)


def _by_lanczos(K_ff: csr_array, extreme: str, **options: Any) -> float:
    """The largest or smallest eigenvalue from a fixed start, with `options` of scipy's `eigsh`."""
    try:
        values = eigsh(K_ff, k=1, v0=_start(K_ff)[:, 0], return_eigenvectors=False, **options)
    except ArpackNoConvergence as error:
        raise RuntimeError(
            f"conditioning: the {extreme} eigenvalue did not converge ({error})"
        ) from error
    return float(values[0])


def _by_lobpcg(K_ff: csr_array, preconditioner: LinearOperator) -> float:
    """Smallest eigenvalue by LOBPCG with four vectors, as the lowest eigenvalues of a body are
    close together.
    """
    vectors = _start(K_ff, 4)
    # start smooth, to save steps
    vectors = np.column_stack([preconditioner @ vector for vector in vectors.T])
    estimate = np.inf
    for _ in range(5):
        scale = estimate if np.isfinite(estimate) else float(K_ff.diagonal().mean())
        with warnings.catch_warnings():
            # its warnings are covered by the check below
            warnings.simplefilter("ignore", UserWarning)
            values, vectors = lobpcg(
                K_ff, vectors, M=preconditioner, largest=False, tol=1e-5 * scale, maxiter=60
            )
        estimate = float(values[0])
        vector = vectors[:, 0]
        residual = float(np.linalg.norm(K_ff @ vector - estimate * vector) / np.linalg.norm(vector))
        # The eigenvalue's error is about residual^2 over the gap to the next eigenvalue.
        if residual <= 1e-4 * estimate:
            return estimate

    def solve(load: Floats) -> Floats:
        solution, failure = cg(K_ff, load.ravel(), rtol=1e-10, maxiter=3000, M=preconditioner)
        if failure:
            raise RuntimeError(
                "conditioning: the smallest eigenvalue did not converge, because a solve did not"
            )
        return solution

    return _by_inverse(K_ff, solve, tol=1e-8)  # slower, but converges if moduli differ widely


def cg_iterations(K_ff: csr_array, load: Floats, rtol: float = RESIDUAL_FRACTION) -> int:
    """Number of steps of diagonally preconditioned conjugate gradients that solve K_ff x = load
    from x = 0.

    Parameters
    ----------
    K_ff : (F, F) csr_array
        Symmetric, positive definite.
    load : (F,) float64
        In `conditioning` it is the system's: the forces of the prescribed displacements. The count
        depends on it, and may differ by one between machines.
    rtol : float
        Residual over load, in 2-norms, of a solution.

    Raises
    ------
    RuntimeError
        No solution after 10 F steps.
    """
    steps = 0

    def count(_: Floats) -> None:
        nonlocal steps
        steps += 1

    jacobi = diags_array(1.0 / K_ff.diagonal())
    _, failed = cg(K_ff, load, rtol=rtol, maxiter=10 * len(load), M=jacobi, callback=count)
    if failed:
        raise RuntimeError(
            f"conditioning: conjugate gradients did not reach {rtol:g} of the load in {steps} steps"
        )
    return steps


def _start(K_ff: csr_array, n_vectors: int = 1) -> Floats:
    """Fixed start vectors, (F, n_vectors), with a part of every eigenvector."""
    return np.random.default_rng(0).standard_normal((K_ff.shape[0], n_vectors))
