"""Reports: what was done and measured, as one page that can be mailed, printed and kept.

A program fills a `Report` and hands it to `write_report`, which leaves `report.json`,
`figures/*.png` and the self-contained `report.html` in the run's folder. `read_report` takes
them up again, and `reports_page` puts several on one page.
"""

from .content import Measurement as Measurement
from .content import Picture as Picture
from .content import Report as Report
from .content import Section as Section
from .content import flatten as flatten
from .folder import REPORT as REPORT
from .folder import read_report as read_report
from .folder import write_report as write_report
from .page import reports_page as reports_page
from .terminal import show_measurements as show_measurements
from .versions import software_versions as software_versions
