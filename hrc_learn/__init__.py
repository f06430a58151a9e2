"""Learn robot arm motions from a few demonstrations and work safely beside people."""
