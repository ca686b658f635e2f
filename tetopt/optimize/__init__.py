"""Moving the nodes: the paper's scheme (`paper`), its steps (`descent`, `retessellate`) and their loop."""
