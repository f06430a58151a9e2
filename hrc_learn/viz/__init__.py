"""Dashboards, figures, films and reports; they import Rerun and Matplotlib themselves."""
