"""Reports of runs, each one self-contained HTML page.

A program fills a `Report`; `write_report` writes `report.json`, pictures, `film.mp4` and
`report.html` to the folder of the run. `read_report` reads them again, and `reports_page` shows
several on one page.
"""

from hrc_learn.viz.report.content import Film as Film
from hrc_learn.viz.report.content import Measurement as Measurement
from hrc_learn.viz.report.content import Picture as Picture
from hrc_learn.viz.report.content import Report as Report
from hrc_learn.viz.report.content import Section as Section
from hrc_learn.viz.report.content import flatten as flatten
from hrc_learn.viz.report.content import leading as leading
from hrc_learn.viz.report.content import show_command as show_command
from hrc_learn.viz.report.content import show_measurements as show_measurements
from hrc_learn.viz.report.content import software_versions as software_versions
from hrc_learn.viz.report.files import FILM as FILM
from hrc_learn.viz.report.files import PAGE as PAGE
from hrc_learn.viz.report.files import REPORT as REPORT
from hrc_learn.viz.report.files import read_report as read_report
from hrc_learn.viz.report.files import reports_page as reports_page
from hrc_learn.viz.report.files import write_report as write_report
