"""Conversion of meshes to and from other libraries, and their display in notebooks."""
