"""The controller in batches of closed loops: grasps, a person's null-space force, stress."""
