"""The paper's experiments and studies of the controller: scenario, metrics, report,
recording.
"""
