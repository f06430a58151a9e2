"""From a dataset's columns to demonstrations in SI units."""
