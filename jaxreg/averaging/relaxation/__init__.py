"""The semidefinite relaxation of averaging, on the host: certificate and staircase."""
