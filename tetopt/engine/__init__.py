"""Moving and connecting the nodes: the loop both engines share, the fast engine, the paper's."""
