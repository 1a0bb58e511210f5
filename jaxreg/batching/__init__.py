"""Many problems of unequal sizes: padded, spread over cores, told of."""
