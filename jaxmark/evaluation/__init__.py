"""Evaluation of marks: robustness curves, studies with controls, and tuning of the strength.

`pictures` draws the results. `tune` chooses the strengths of the bands for the attacks that a mark must survive;
`tune_blind` chooses the width and the step of a blind mark.
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
