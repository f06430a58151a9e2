"""The page in a browser on which a person looks at demonstrations and decides what stays."""

from hrc_learn.teleoperation.curation_page.server import CurationPage as CurationPage
