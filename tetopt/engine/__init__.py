"""Optimisation of node positions and connectivity: the fast engine, the paper's, and their
common loop.
"""
