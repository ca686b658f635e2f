"""The two error terms of the paper, E_G (Eq. 1) and E_D (Eq. 3), and the sampling that they use."""
