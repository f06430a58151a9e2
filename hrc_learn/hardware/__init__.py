"""Real arms, grippers and cameras."""
