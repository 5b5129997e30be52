"""The type checker that tests run under: an int is a float, as Python's own type system has it."""

from beartype import BeartypeConf, beartype

check = beartype(conf=BeartypeConf(is_pep484_tower=True))
