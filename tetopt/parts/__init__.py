"""Meshes larger than memory, optimised in parts and rounds: shared nodes stay, and are inside a
part in the next.
"""
