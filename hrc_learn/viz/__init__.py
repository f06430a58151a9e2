"""Dashboards, figures, films and reports. Only modules that need Rerun or Matplotlib import
it.
"""
