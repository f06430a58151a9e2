"""Skills: visual servoing, grasping, placing, pick-and-place. They know protocols, not
devices.
"""
