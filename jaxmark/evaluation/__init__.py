"""Evaluation: what a mark survives, by robustness curves and by studies with controls, and how strong it should be.

`pictures` draws their results; `tune` chooses the strengths of the bands for the attacks that a mark
must survive, `tune_blind` width and step of a mark that is read without the original.
"""

from jaxmark.evaluation._rates import Control as Control
from jaxmark.evaluation._rates import Row as Row
from jaxmark.evaluation._rates import rates as rates
from jaxmark.evaluation._robustness import Outcome as Outcome
from jaxmark.evaluation._robustness import Robustness as Robustness
from jaxmark.evaluation._robustness import minimum_distortion as minimum_distortion
from jaxmark.evaluation._robustness import robustness as robustness
from jaxmark.evaluation.study import Study as Study
from jaxmark.evaluation.study_results import Results as Results
from jaxmark.evaluation.tuning import Tuned as Tuned
from jaxmark.evaluation.tuning import TunedBlind as TunedBlind
from jaxmark.evaluation.tuning import tune as tune
from jaxmark.evaluation.tuning import tune_blind as tune_blind
