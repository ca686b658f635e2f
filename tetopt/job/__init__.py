"""A run, from files to files: what is asked for, planned, read, meshed, measured and written."""
