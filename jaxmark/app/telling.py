"""What was done or found, in words for people and in values for programs."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import click

from jaxmark.errors import JaxmarkError
from jaxmark.watermark.blind.reading import BlindDetection
from jaxmark.watermark.marking import Detection, Survival


class Told(NamedTuple):
    """The outcome for one file."""

    answer: dict[str, Any]  # for programs: values for JSON, except that numbers may not be finite
    said: str  # for people: one sentence
    done: bool = True  # False if nothing was detected, or the file was refused
    refused: bool = False


def told_error(error: Exception) -> str:
    """What an exception says, in one line."""
    match error:
        case click.ClickException():
            said = error.format_message()
        case JaxmarkError():
            said = str(error)
        case OSError():
            said = f"{error.filename or 'A file'} cannot be used: {error.strerror or error}."
        case _:
            said = f"Unexpected {type(error).__name__}: {error}. Please report it, with the command and the files."
    return " ".join(said.split())


def power(log10_p: float) -> str:
    """A bound as a power of ten, which rounding makes no smaller."""
    return f"10^{math.ceil(10 * log10_p - 1e-9) / 10 + 0.0:.1f}"


def told_payload(bits: int) -> str:
    """What a mark carries."""
    return f"{bits} bits" if bits else "presence"


def told_message(message: bytes) -> str:
    """A message in hexadecimal digits, and as text if it is one."""
    try:
        text = message.decode()
    except UnicodeDecodeError:
        text = ""
    return f'{message.hex()} ("{text}")' if text.isprintable() and text else message.hex()


def told_survival(survives: Survival) -> str:
    """What a mark survives, in words."""
    if math.isinf(survives.whole):
        return "an unknown noise, as this scheme has no model of it"
    whole, half = (f"{100 * noise:.2g} %" if noise else "none" for noise in survives)
    if not survives.whole:
        return "no noise to speak of, only what leaves vertices in their places"
    return f"noise of {whole} of the mean distance to the centre, {half} with half of the vertices lost"


def describe(
    found: Detection | BlindDetection, detected: bool, alpha: float, dated: float | None, remarks: Sequence[str]
) -> str:
    """What was found, in words."""
    read = f"message {told_message(found.message)}" if found.message is not None else "no message could be read"
    said = f"{'detected' if detected else 'nothing detected'}: {read}; "
    if found.doubts:
        said += f"false-positive probability about {power(found.log10_p)}, an estimate: {'; '.join(found.doubts)}"
    else:
        said += (
            f"false-positive probability at most {power(found.log10_p)} if {found.premises} were fixed"
            f" before the suspect existed, {power(found.log10_p_undated)} if nothing dates them"
        )
        if dated is not None:
            said += f", {power(dated)} if the deposit is older than the suspect"
    return " ".join([f"{said} (--alpha {alpha:g})", *remarks])
