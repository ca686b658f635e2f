"""Meshes as other libraries and notebooks hold and show them."""
