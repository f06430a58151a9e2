"""From sampled demonstrations to the weights of a primitive."""
