"""What the mesh is to represent."""
