"""What a solver is told beside the mesh: named sets, laws and materials, loads, units."""
