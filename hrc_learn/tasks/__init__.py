"""The pieces put to work: demonstrating, learning, grasping, placing, the whole collaboration.

Each module is imported by itself, so that learning from a dataset needs no simulator.
"""
