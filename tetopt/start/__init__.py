"""The initial mesh: lattices, octree and its leaves' cells, sizes, clipping at a mask, Delaunay."""
