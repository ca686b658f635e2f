"""What a solver is told beside the mesh: named sets, modulus mappings and materials, loads, units."""
