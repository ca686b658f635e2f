"""Finite elements on the mesh: elastic moduli from intensities, linear elasticity, strain energy, conditioning."""
