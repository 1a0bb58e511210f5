"""Linear systems of graphs: Laplacians, multigrid, conjugate gradients; arrays only."""
