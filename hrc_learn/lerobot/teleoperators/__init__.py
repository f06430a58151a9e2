"""Who leads a Panda: a script that shows a job, or a person in a browser."""

from .config_panda_expert import PandaExpertConfig as PandaExpertConfig
from .config_panda_page import PandaPageConfig as PandaPageConfig
from .panda_expert import PandaExpert as PandaExpert
from .panda_page import PandaPage as PandaPage
