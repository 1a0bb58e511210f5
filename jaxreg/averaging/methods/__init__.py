"""Methods of motion averaging, one algorithm a file."""
