"""Attacks by enemies, a module for each thing that they know: more than chance does, less than the owner.

Those of `jaxmark.attacks` are what happens to any mesh; these are made for a watermark, and each returns an `Attack`,
which goes wherever a name of `ATTACKS` does.
"""

from jaxmark.attacks.adversarial.blind import descent as descent
from jaxmark.attacks.adversarial.blind import evolution as evolution
from jaxmark.attacks.adversarial.blind import remarking as remarking
from jaxmark.attacks.adversarial.blind import subtraction as subtraction
from jaxmark.attacks.adversarial.key_holder import erasure as erasure
from jaxmark.attacks.adversarial.key_holder import erasure_by_descent as erasure_by_descent
