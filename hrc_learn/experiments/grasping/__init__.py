"""Experiment 2 of the paper: a grasp with an uncalibrated camera."""
