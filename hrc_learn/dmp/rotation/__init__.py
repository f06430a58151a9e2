"""Orientations as a linear system: errors to the goal and their formulations."""
