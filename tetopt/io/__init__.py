"""Reading and writing files, with one module per family of formats."""
