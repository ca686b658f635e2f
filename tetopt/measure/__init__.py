"""What came of it: quality, fidelity to masks and labels, segmentation."""
