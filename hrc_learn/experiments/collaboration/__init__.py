"""Experiment 3 of the paper: people in the whole job."""
