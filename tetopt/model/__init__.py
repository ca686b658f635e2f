"""What a solver is told beside the mesh: named sets, materials, loads, units."""
