"""Attacks on a watermark by adversaries, with one module for each kind of adversary's knowledge.

The attacks of `jaxmark.attacks` may happen to any mesh; the attacks here are directed against a watermark. Each attack
on a mesh is an `Attack`, which can be used in place of a name in `ATTACKS`. The module `ambiguity` attacks the proof of
a detection instead of the mark.
"""

from jaxmark.adversaries.ambiguity import Search as Search
from jaxmark.adversaries.ambiguity import forge_original as forge_original
from jaxmark.adversaries.ambiguity import search_key as search_key
from jaxmark.adversaries.ambiguity import transplant as transplant
from jaxmark.adversaries.by_name import ATTACKS as ATTACKS
from jaxmark.adversaries.by_name import attack as attack
from jaxmark.adversaries.by_name import attack_each as attack_each
from jaxmark.adversaries.by_name import band_stop as band_stop
from jaxmark.adversaries.by_name import chain as chain
from jaxmark.adversaries.by_name import get_attack as get_attack
from jaxmark.adversaries.by_name import jamming as jamming
from jaxmark.adversaries.by_name import low_pass as low_pass
from jaxmark.adversaries.chains import Chain as Chain
from jaxmark.adversaries.chains import Gene as Gene
from jaxmark.adversaries.chains import chain_attack as chain_attack
from jaxmark.adversaries.chains import projected_cost as projected_cost
from jaxmark.adversaries.chains import search_chain as search_chain
from jaxmark.adversaries.collusion import Rule as Rule
from jaxmark.adversaries.collusion import collude as collude
from jaxmark.adversaries.collusion import combine as combine
from jaxmark.adversaries.expected import Surrogate as Surrogate
from jaxmark.adversaries.expected import evidence as evidence
from jaxmark.adversaries.expected import make_surrogate as make_surrogate
from jaxmark.adversaries.expected import random_mark as random_mark
from jaxmark.adversaries.expected import rescale as rescale
from jaxmark.adversaries.key_holder import erasure as erasure
from jaxmark.adversaries.key_holder import erasure_by_descent as erasure_by_descent
from jaxmark.adversaries.keyless import Family as Family
from jaxmark.adversaries.keyless import descent as descent
from jaxmark.adversaries.keyless import evolution as evolution
from jaxmark.adversaries.keyless import rewatermarking as rewatermarking
from jaxmark.adversaries.keyless import subtraction as subtraction
from jaxmark.adversaries.networks import Goal as Goal
from jaxmark.adversaries.networks import Learned as Learned
from jaxmark.adversaries.networks import Network as Network
from jaxmark.adversaries.networks import learn as learn
from jaxmark.adversaries.networks import learned_attack as learned_attack
from jaxmark.adversaries.oracle import Counted as Counted
from jaxmark.adversaries.oracle import boundary as boundary
from jaxmark.adversaries.oracle import decide_by_score as decide_by_score
from jaxmark.adversaries.oracle import decision_oracle as decision_oracle
from jaxmark.adversaries.oracle import estimated_gradient as estimated_gradient
from jaxmark.adversaries.oracle import quantise_scores as quantise_scores
from jaxmark.adversaries.oracle import random_search as random_search
from jaxmark.adversaries.oracle import randomise_scores as randomise_scores
from jaxmark.adversaries.oracle import score_oracle as score_oracle
