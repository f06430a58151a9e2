"""Which episodes a person should look at first, what was decided, and the cleaned copy."""

from hrc_learn.demos.curation.decisions import Decision as Decision
from hrc_learn.demos.curation.decisions import Decisions as Decisions
from hrc_learn.demos.curation.decisions import keep_decisions as keep_decisions
from hrc_learn.demos.curation.decisions import read_decisions as read_decisions
from hrc_learn.demos.curation.decisions import write_curated as write_curated
from hrc_learn.demos.curation.ranking import MEASURES as MEASURES
from hrc_learn.demos.curation.ranking import EpisodeQuality as EpisodeQuality
from hrc_learn.demos.curation.ranking import Ranking as Ranking
from hrc_learn.demos.curation.ranking import rank_episodes as rank_episodes
