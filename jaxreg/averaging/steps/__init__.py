"""What methods of averaging repeat: weights, one solve, updated poses."""
