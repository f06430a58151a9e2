"""From sampled motions to the weights of a primitive."""
