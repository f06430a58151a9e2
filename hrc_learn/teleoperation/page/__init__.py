"""Browser page from which a person guides the arm; needs the extra `ui`."""

from hrc_learn.teleoperation.page.page import Page as Page
from hrc_learn.teleoperation.page.page import PageConfig as PageConfig
from hrc_learn.teleoperation.page.page_operator import PageHuman as PageHuman
from hrc_learn.teleoperation.page.panel import PageStatus as PageStatus
