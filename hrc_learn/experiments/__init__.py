"""The paper's experiments, in simulation and on a real arm: scenarios, metrics, reports and
recordings.
"""
