"""A mesh too large for one memory, optimised in parts, round by round: what they share stays, and is inside next."""
