"""All attacks by their names: what happens to meshes by accident or by a tool, and what keyless attackers do."""

from collections.abc import Mapping

from jaxmark.adversaries._jamming import jamming
from jaxmark.adversaries.filtering import band_stop, low_pass
from jaxmark.attacks import registry
from jaxmark.attacks.registry import Attack, Registry

_REGISTRY = Registry(
    {
        **registry.ATTACKS,
        "low-pass": Attack(
            low_pass, "share of the spectrum, removed from the top", (0.3, 0.5, 0.7, 0.8, 0.9), faces=True
        ),
        "band-stop": Attack(
            band_stop, "width in λ of the band that is removed, from 0.02 up", (0.02, 0.05, 0.1, 0.2, 0.4), faces=True
        ),
        "jamming": Attack(jamming, "RMS over the diagonal", (0.0001, 0.0002, 0.0005, 0.001, 0.002), faces=True),
    }
)
#: All attacks of the library, by the names that the command line uses.
ATTACKS: Mapping[str, Attack] = _REGISTRY.attacks
attack, attack_each, chain, get_attack = _REGISTRY.attack, _REGISTRY.attack_each, _REGISTRY.chain, _REGISTRY.get
