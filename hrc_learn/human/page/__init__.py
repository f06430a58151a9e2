"""A page in a browser from which a person leads the arm; needs the extra `ui`."""

from .config import PageConfig as PageConfig
from .config import PageStatus as PageStatus
from .page import Page as Page
from .person import PageHuman as PageHuman
