"""Measures of a mesh: quality, fidelity to masks and labels, segmentation."""
