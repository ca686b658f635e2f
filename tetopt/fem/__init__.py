"""Finite elements on the mesh: linear elasticity, strain energy, conditioning, the voxel
reference.
"""
