"""The conventional way, for comparison: segment, extract surfaces, fill them with tetrahedra."""
