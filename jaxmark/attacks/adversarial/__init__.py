"""Attacks by enemies, a module for each thing that they know: more than chance does, less than the owner.

Those of `jaxmark.attacks` are what happens to any mesh; these are made for a watermark, and each returns an `Attack`,
which goes wherever a name of `ATTACKS` does; but for those of `ambiguity`, which attack what a detection says.
"""

from jaxmark.attacks.adversarial.ambiguity import Search as Search
from jaxmark.attacks.adversarial.ambiguity import forged_original as forged_original
from jaxmark.attacks.adversarial.ambiguity import searched_key as searched_key
from jaxmark.attacks.adversarial.ambiguity import transplanted as transplanted
from jaxmark.attacks.adversarial.blind import Family as Family
from jaxmark.attacks.adversarial.blind import descent as descent
from jaxmark.attacks.adversarial.blind import evolution as evolution
from jaxmark.attacks.adversarial.blind import remarking as remarking
from jaxmark.attacks.adversarial.blind import subtraction as subtraction
from jaxmark.attacks.adversarial.collusion import Rule as Rule
from jaxmark.attacks.adversarial.collusion import colluded as colluded
from jaxmark.attacks.adversarial.collusion import combined as combined
from jaxmark.attacks.adversarial.key_holder import erasure as erasure
from jaxmark.attacks.adversarial.key_holder import erasure_by_descent as erasure_by_descent
from jaxmark.attacks.adversarial.oracle import Counted as Counted
from jaxmark.attacks.adversarial.oracle import boundary as boundary
from jaxmark.attacks.adversarial.oracle import decided as decided
from jaxmark.attacks.adversarial.oracle import decision_oracle as decision_oracle
from jaxmark.attacks.adversarial.oracle import estimated_gradient as estimated_gradient
from jaxmark.attacks.adversarial.oracle import quantised as quantised
from jaxmark.attacks.adversarial.oracle import random_search as random_search
from jaxmark.attacks.adversarial.oracle import randomised as randomised
from jaxmark.attacks.adversarial.oracle import score_oracle as score_oracle
