"""Reading of datasets: from columns to demonstrations in SI units."""
