"""The first mesh: lattices, octree, sizes, clipping at a mask, Delaunay."""
