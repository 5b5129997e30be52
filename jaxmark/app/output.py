"""The output of commands: sentences for people, JSON for programs, and checks of the paths that are written."""

import json
import math
import os
import sys
from collections.abc import Iterable, Mapping
from enum import IntEnum
from pathlib import Path
from typing import Any, NamedTuple

import click

from jaxmark.app.printable import printable
from jaxmark.app.progress import current
from jaxmark.errors import JaxmarkError
from jaxmark.files.atomic import file_hash
from jaxmark.watermark.evidence.detection import Detection, Evidence
from jaxmark.watermark.evidence.ledger import charges_as_json, rounded_up
from jaxmark.watermark.perception.capacity import Survival

ESTIMATE = "estimate, not a proof"  # how the text of an estimate begins


class Status(IntEnum):
    """The exit status of a command, and the outcome for one of several files."""

    DONE = 0  # also if a mark is detected, an original named or a recipient accused
    NOTHING = 1
    REFUSED = 2
    ESTIMATE = 3  # the figures would suffice for a detection, but they have caveats

    @classmethod
    def of(cls, proven: bool, sufficient: bool) -> "Status":
        """Return the status of a reading.

        Args:
            proven: whether it has a proof with sufficient figures.
            sufficient: whether it has sufficient figures, with or without caveats.
        """
        return cls.DONE if proven else cls.ESTIMATE if sufficient else cls.NOTHING

    @classmethod
    def worst(cls, statuses: Iterable["Status"]) -> "Status":
        """Return the status of several files, which is at most as good as that of each: 0 before 3, 1 and 2."""
        return max(statuses, key=[cls.DONE, cls.ESTIMATE, cls.NOTHING, cls.REFUSED].index, default=cls.DONE)


class FileOutcome(NamedTuple):
    """The outcome for one file."""

    values: dict[str, Any]  # for programs: values for JSON, except that numbers may not be finite
    lines: tuple[str, ...]  # for people: one sentence, and further lines
    status: Status = Status.DONE


def say(line: str, err: bool = True) -> None:
    """Print a line that is not part of the answer; by default on standard error."""
    current().clear()
    click.echo(printable(line), err=err)


def answer(as_json: bool, values: Mapping[str, Any], *lines: str) -> None:
    """Print an answer: its values as one line of JSON, or its lines."""
    current().clear()
    try:
        click.echo(json.dumps(_finite(values), allow_nan=False) if as_json else "\n".join(map(printable, lines)))
        sys.stdout.flush()
    except BrokenPipeError:
        # The program that reads our output has ended. The work is done, and the exit status still reports the result.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _finite(value: Any) -> Any:
    """Replace numbers that are not finite, which JSON does not have, by None."""
    if isinstance(value, Mapping):
        return {name: _finite(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def error_text(error: Exception) -> str:
    """Return the message of an exception in one line."""
    match error:
        case click.ClickException():
            text = error.format_message()
        case JaxmarkError():
            text = str(error)
        case OSError():
            text = f"{error.filename or 'A file'} cannot be used: {error.strerror or error}."
        case _:
            text = f"Unexpected {type(error).__name__}: {error}. Please report it, with the command and the files."
    return " ".join(text.split())


def power(log10_p: float) -> str:
    """Format a bound as a power of ten, rounded up."""
    return f"10^{rounded_up(log10_p):.1f}"


def payload_text(bits: int) -> str:
    """Describe the payload of a mark."""
    return f"{bits} bits" if bits else "presence"


def message_text(message: bytes) -> str:
    """Format a message in hexadecimal digits, followed by its text if it is printable UTF-8."""
    try:
        text = message.decode()
    except UnicodeDecodeError:
        text = ""
    return f'{message.hex()} ("{text}")' if text.isprintable() and text else message.hex()


def survival_text(survives: Survival) -> str:
    """Describe the noise that a mark survives."""
    if math.isinf(survives.whole):
        return "an unknown amount of noise, because this scheme has no noise model"
    if not survives.whole:
        return "hardly any noise, only attacks that do not displace vertices"
    whole, half = (f"{100 * noise:.2g} %" for noise in survives)
    text = f"noise of {whole} of the mean distance to the centre"
    return f"{text}, {half} with half of the vertices lost" if survives.half else f"{text} where no part is lost"


def detection_status(detection: Detection, alpha: float) -> Status:
    """Return the status of a detection."""
    return Status.of(detection.detected(alpha), detection.detected(alpha, allow_estimate=True))


#: The first words of the text of a detection.
VERDICTS = {Status.DONE: "detected", Status.ESTIMATE: ESTIMATE, Status.NOTHING: "nothing detected"}


def detection_lines(
    detection: Detection, alpha: float, timestamped: Evidence | None, *, charges: bool = False
) -> tuple[str, ...]:
    """Describe a detection in words, in one line, and further lines for charges.

    Args:
        detection: the detection.
        alpha: largest false-positive probability of a detection.
        timestamped: the evidence if the commitment is older than the suspect; None without a commitment.
        charges: whether to list how much each choice of the reader cost.
    """
    evidence = detection.evidence
    status = detection_status(detection, alpha)
    text = f"{VERDICTS[status]}: {_content_text(detection, status)}; "
    if evidence.caveats:
        text += (
            f"false-positive probability about {power(detection.log10_p)}, an estimate: {'; '.join(evidence.caveats)}"
        )
    else:
        text += f"false-positive probability at most {power(detection.log10_p)}"
        if detection.log10_p < 0:  # otherwise the bound is 1, whatever was fixed
            text += (
                f" if {detection.premises} were fixed before the suspect existed,"
                f" {power(evidence.log10_p_uncommitted)} even if they were chosen afterwards"
            )
        if timestamped is not None:
            text += f", {power(timestamped.log10_p)} if the commitment is older than the suspect"
    notes = detection.notes
    # Nothing was read of the original itself, whose estimates are all 0.
    was_read = detection.scores.any()
    if status is Status.NOTHING and was_read and detection.message is None and detection.claimed is None:
        notes += ("A claim needs less evidence: if you know the message, give it by --message.",)
    text = " ".join([f"{text} (--alpha {alpha:g})" + "." * bool(notes), *notes])
    if charges:
        named = {
            "": timestamped or evidence,
            **{f" of {name}": part.evidence for name, part in detection.parts.items()},
        }
        return text, *(f"charged in log10 p{name}: {_charged(entry)}" for name, entry in named.items())
    return (text,)


def _content_text(detection: Detection, status: Status) -> str:
    """Describe what was read."""
    if detection.message is not None:
        return f"message {message_text(detection.message)}"
    if status is Status.NOTHING or not detection.claimed:
        return "no message could be read"
    return f"the claimed message {message_text(detection.claimed)}, which could not be decoded"


def _charged(evidence: Evidence) -> str:
    return ", ".join(f"{one.choice}: {one.taken} {one.log10:.2f}" for one in evidence.charges) or "nothing"


def detection_values(
    detection: Detection,
    alpha: float,
    suspect: Path,
    obtained: str,
    timestamped: Evidence | None,
    record_digest: str | None,
) -> dict[str, Any]:
    """Describe a detection as values for JSON.

    Args:
        detection: the detection.
        alpha: see `detection_lines`.
        suspect: the suspect's file.
        obtained: when and where the suspect was obtained.
        timestamped: see `detection_lines`.
        record_digest: digest of the record; None without a record.
    """
    values = {
        **_figures(detection, alpha),
        "notes": list(detection.notes),
        "scheme": detection.scheme,
        "version": detection.version,
        "suspect_sha256": file_hash(suspect),
        "obtained": obtained or None,
        "scores": detection.scores.tolist(),
        "coverage": detection.coverage,
        "registration": detection.registration.facts(),
    }
    if detection.parts:
        values["parts"] = {
            name: {**_figures(part, alpha), "coverage": part.coverage, "registration": part.registration.facts()}
            for name, part in detection.parts.items()
        }
        values["skipped"] = dict(detection.skipped)
    if record_digest is not None:
        values["record_digest"] = record_digest
    if timestamped is not None:
        values["log10_p_timestamped"] = timestamped.log10_p
        values["charges_timestamped"] = charges_as_json(timestamped.charges)
    return values


def _figures(detection: Detection, alpha: float) -> dict[str, Any]:
    evidence, status = detection.evidence, detection_status(detection, alpha)
    return {
        "detected": status is Status.DONE,
        "estimate": status is Status.ESTIMATE,
        "message": None if detection.message is None else detection.message.hex(),
        "log10_p": evidence.log10_p,
        "log10_p_uncommitted": evidence.log10_p_uncommitted,
        "log10_p_gaussian": evidence.log10_p_gaussian,
        "log10_p_unfloored": evidence.log10_p_unfloored,
        "caveats": list(evidence.caveats),
        "charges": charges_as_json(evidence.charges),
    }


def check_suffix(source: Path, target: Path) -> None:
    """Raise an error if an output file has another format than its source."""
    if source.suffix.lower() != target.suffix.lower():
        raise JaxmarkError(f"{target} must have the suffix of {source}, because it keeps the format of that file.")


def check_distinct(**files: Path) -> None:
    """Raise an error if two arguments name the same file, because an input would be overwritten."""
    names: dict[str, str] = {}
    for name, path in files.items():
        other = names.setdefault(os.path.realpath(path), name)
        if other != name:
            raise JaxmarkError(f"{other} and {name} are the same file, {path}; give another name.")


def make_folder(folder: Path) -> Path:
    """Create a folder, if it does not exist.

    Raises:
        JaxmarkError: if it cannot be created.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise JaxmarkError(f"The folder {folder} cannot be created: {error.strerror}.") from None
    return folder
