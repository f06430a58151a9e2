"""Experiment 1 of the paper: a placing motion, repeated for other shelves."""
