"""Who leads a Panda: a script that shows a job, or a person in a browser."""

from hrc_learn.lerobot.teleoperators.panda_teleoperators import PandaExpert as PandaExpert
from hrc_learn.lerobot.teleoperators.panda_teleoperators import (
    PandaExpertConfig as PandaExpertConfig,
)
from hrc_learn.lerobot.teleoperators.panda_teleoperators import PandaPage as PandaPage
from hrc_learn.lerobot.teleoperators.panda_teleoperators import (
    PandaPageConfig as PandaPageConfig,
)
