"""A run, from files to files: planning, reading, meshing, measuring and writing."""
