"""Who leads a Panda: a script that shows a job, or a person in a browser."""

from hrc_learn.lerobot.teleoperators.config_panda_expert import (
    PandaExpertConfig as PandaExpertConfig,
)
from hrc_learn.lerobot.teleoperators.config_panda_page import PandaPageConfig as PandaPageConfig
from hrc_learn.lerobot.teleoperators.panda_expert import PandaExpert as PandaExpert
from hrc_learn.lerobot.teleoperators.panda_page import PandaPage as PandaPage
