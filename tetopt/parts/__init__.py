"""A mesh too large for one memory, optimised in parts: each a mesh of its own, whose shared nodes stay, round by round."""
