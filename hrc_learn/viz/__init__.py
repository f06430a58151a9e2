"""Dashboards, figures, films and reports; Rerun and Matplotlib are imported only if needed."""
