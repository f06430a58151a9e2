"""Experiment 3 of the paper: the whole job beside a person."""
