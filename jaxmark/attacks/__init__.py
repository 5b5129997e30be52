"""Attacks: what may happen to a marked mesh. `ATTACKS` lists them by the names the command line uses."""

from jaxmark.attacks.noise import uniform_noise as uniform_noise
from jaxmark.attacks.quantisation import quantisation as quantisation
from jaxmark.attacks.registry import ATTACKS as ATTACKS
from jaxmark.attacks.registry import Attack as Attack
from jaxmark.attacks.registry import attack as attack
from jaxmark.attacks.smoothing import laplacian_smoothing as laplacian_smoothing
