"""Solver input in addition to the mesh: named sets, modulus mappings and materials, loads,
units.
"""
