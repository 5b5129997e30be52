"""The tables of a benchmark as text, for HTML pages and Markdown."""

from __future__ import annotations  # so that `help` shows the names of type aliases, not their definitions

import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import product
from typing import Any, NamedTuple

from jaxmark.bench.readings import BenchResults
from jaxmark.bench.summary import NOT_VALIDATED, entries
from jaxmark.bench.tasks import COSTS

Entries = Mapping[str, dict[str, Any]]


class Table(NamedTuple):
    """A table of a page."""

    title: str
    heads: Sequence[str]
    lines: Sequence[Sequence[str]]
    note: str = ""

    def markdown(self) -> str:
        """Format the table as Markdown."""
        rows = [[re.sub(r"\s+", " ", cell).replace("|", "\\|") for cell in row] for row in (self.heads, *self.lines)]
        text = [f"| {' | '.join(row)} |" for row in rows]
        text.insert(1, "|---" * len(self.heads) + "|")
        note = ["", self.note] if self.note else []
        return "\n".join([f"## {self.title}", *note, "", *text])


def tables(results: BenchResults) -> list[Table]:
    """Make all tables of a benchmark."""
    every = entries(results)
    groups = _groups(every)
    several = len({payload for payload, _, _ in groups}) > 1
    made = [
        _table(
            "Scores",
            _scores(every),
            "Area under the curve of the fraction of marks that survive, as a function of the attack's distortion (0 to"
            " 1), with 95 % intervals over meshes and seeds. The columns of metrics are the areas of `detected`, by"
            " metric of distortion. †: this code of the method was not validated against a published figure.",
        ),
        _table(
            "Calibration",
            _calibrations(every),
            "Nulls are suspects without a mark of the key, which each reader reads. A mark counts as detected if its"
            " score exceeds the threshold; the threshold is chosen so that the expected false-positive rate is at most"
            f" {results.rate:g}. The interval of the rate is exact if all nulls have one distribution.",
        ),
    ]
    for (payload, track, limits), parts in groups.items():
        title = f"{track}, {limits} limits{f', {payload} bits' if several else ''}"
        made += [
            _table(f"{title}: the marks", _marks(parts, every)),
            _attacks(f"{title}: robustness", parts, every),
            _table(f"{title}: distortion by the attacks", _costs(parts)),
        ]
    paired_note = (
        "Marks detected by both methods, or by one of them, on the same meshes, seeds, limits and attacks. Interval and"
        " p only describe these suspects, because suspects from one mark are not independent of each other."
    )
    skipped = ({"attack": name, "reason": reason} for name, reason in results.skipped.items())
    rest = [
        _table("Refused", _refused(groups, every)),
        _table("Paired comparison", _paired(results, every), paired_note),
        _table("Skipped", skipped),
    ]
    return made + [table for table in rest if table.lines]


Row = Mapping[str, str]  # cells by the heads of their columns


def _table(title: str, rows: Iterable[Row], note: str = "") -> Table:
    lines = list(rows)
    return Table(title, list(lines[0]) if lines else [], [list(row.values()) for row in lines], note)


def _groups(entries: Entries) -> dict[tuple[str, str, str], dict[str, Any]]:
    """Group the parts of all methods by payload, track and limits."""
    groups: dict[tuple[str, str, str], dict[str, Any]] = defaultdict(dict)
    for payload in sorted({payload for entry in entries.values() for payload in entry["payloads"]}, key=int):
        for name, entry in entries.items():
            for track, summary in entry["payloads"].get(payload, {"tracks": {}})["tracks"].items():
                for limits, part in summary["limits"].items():
                    groups[payload, track, limits][name] = part
    return groups


def _label(name: str, entry: Mapping[str, Any]) -> str:
    """Return a method's name, with a dagger if the method is not validated."""
    return f"{name}†" if entry["validated"] == NOT_VALIDATED else name


def _payloads(entries: Entries) -> Iterator[tuple[str, str, Mapping[str, Any], Mapping[str, Any]]]:
    """Yield label, payload, entry and part of each method and payload; a method may have a fixed payload, or none."""
    for name, entry in entries.items():
        for payload, part in entry["payloads"].items():
            bits = payload if len(entry["payloads"]) > 1 else str(entry["bits"])
            yield _label(name, entry), bits if entry["bits"] else "-", entry, part


def _number(value: float | None, form: str = ".3g") -> str:
    return "-" if value is None else f"{value:{form}}"


def _interval(value: float, low: float, high: float, form: str) -> str:
    return f"{value:{form}} ({low:{form}} - {high:{form}})"


def _share(counts: Mapping[str, Any], of: str = "hits") -> str:
    return f"{counts[of]}/{counts['trials']}"


def _scores(entries: Entries) -> Iterator[Row]:
    for label, bits, entry, part in _payloads(entries):
        for track, summary in part["tracks"].items():
            row = {"method": label, "reader": "blind" if entry["blind"] else "non-blind", "bits": bits, "track": track}
            for rule, score in summary["scores"].items():
                row[rule] = "-"
                if score is not None and (rule == "detected" or entry["bits"]):
                    row[rule] = _interval(score["value"], score["low"], score["high"], ".2f")
            areas = (summary["scores"]["detected"] or {"areas": {}})["areas"]
            row |= {metric.upper(): _number(areas.get(metric), ".2g") for metric in COSTS}
            yield {**row, "validated by": entry["validated"]}


def _calibrations(entries: Entries) -> Iterator[Row]:
    for label, bits, _, part in _payloads(entries):
        if (calibration := part["calibration"]) is None:
            continue
        own, bound, nulls = calibration["own_threshold"], calibration["bound"], calibration["nulls"]
        passed = ", ".join(f"10^{level['log10_p']:g}: {_share(level)}" for level in bound if level["hits"])
        yield {
            "method": label,
            "bits": bits,
            "nulls above the threshold": ", ".join(f"{kind}: {_share(counts)}" for kind, counts in nulls.items()),
            "threshold": _number(calibration["threshold"]),
            "rate (95 %)": _interval(calibration["rate"], calibration["rate_low"], calibration["rate_high"], ".2g"),
            "nulls at its own threshold": f"{_share(own)}, stated {own['stated']:g}" if own else "-",
            "nulls within its bound": (passed or f"none of {bound[0]['trials']}") if bound else "-",
            "ROC area": f"{calibration['roc_area']:.3f}",
            "verdict": " ".join(calibration["verdicts"]) or "holds",
        }


def _marks(parts: Mapping[str, Any], entries: Entries) -> Iterator[Row]:
    for name, part in parts.items():
        marks = part["marks"]
        row = {"method": _label(name, entries[name]), "made": f"{marks['made']}/{marks['tried']}"}
        row |= {metric.upper(): _number(marks.get(metric)) for metric in ("rms", *COSTS)}
        yield {**row, "s": _number(marks["seconds"], ".2g"), "notes": "; ".join(marks["notes"]) or "-"}


def _attacks(title: str, parts: Mapping[str, Any], entries: Entries) -> Table:
    def cell(name: str, rates: Mapping[str, Any] | None) -> str:
        if rates is None:
            return "-"
        detected = _share(rates, "detected")
        read = _share(rates, "read") if entries[name]["bits"] else ""
        text = f"{read} {rates['bit_errors']:.2f}" if read else ""
        text += "" if read == detected else f" [{detected}]"
        return f"{text} {_number(rates['log10_p'], '.1f')}".removesuffix(" -").strip()

    parts = {name: part for name, part in parts.items() if part["marks"]["made"]}
    lines = []
    for attack in dict.fromkeys(attack for part in parts.values() for attack in part["attacks"]):
        of_attack = {name: part["attacks"].get(attack) for name, part in parts.items()}
        published = next((p for rates in of_attack.values() if rates and (p := rates.get("published_bit_errors"))), {})
        line = [attack, *(cell(name, rates) for name, rates in of_attack.items())]
        lines.append([*line, *(_number(published.get(name), ".2f") for name in ("cho", "wang"))])
    heads = ["attack", *(_label(name, entries[name]) for name in parts), "Cho, published", "Wang, published"]
    if all(line[-2:] == ["-", "-"] for line in lines):  # no rates were published for this track
        heads, lines = heads[:-2], [line[:-2] for line in lines]
    note = (
        "Each cell has the suspects from which the exact message is read and the mean bit error rate of the best guess;"
        " in brackets, the suspects that are detected, if their number differs; and the median log10 p, if the method"
        " bounds it. Methods that marked no mesh are left out."
    )
    return Table(title, heads, lines, note)


def _costs(parts: Mapping[str, Any]) -> Iterator[Row]:
    """Tabulate the mean distortion of the attacks, over the meshes and samples that the first method marked."""
    for attack, rates in next(iter(parts.values()))["attacks"].items():
        yield {"attack": attack, **{name.upper(): _number(rates["costs"][name]) for name in COSTS}}


def _refused(groups: Mapping[tuple[str, str, str], Mapping[str, Any]], entries: Entries) -> Iterator[Row]:
    """Tabulate the refusals of methods and attacks, and their number; reasons that differ in numbers count as one."""
    reasons: dict[str, str] = {}  # the first reason of each form
    places: dict[tuple[str, str], list[str]] = defaultdict(list)
    for name, entry in entries.items():
        for (_, track, limits), parts in groups.items():
            for attack, rates in parts.get(name, {"attacks": {}})["attacks"].items():
                for note in rates["notes"]:
                    reason = reasons.setdefault(re.sub(r"\d+(\.\d+)?", "#", note), note)
                    places[_label(name, entry), reason].append(f"{track}, {limits}: {attack}")
    for (label, reason), attacks in places.items():
        yield {"method": label, "reason": reason, "attacks": str(len(attacks)), "first attack": attacks[0]}


def _paired(results: BenchResults, entries: Entries) -> Iterator[Row]:
    """Tabulate the paired comparisons of the first method with each other method."""
    (first, label), *others = zip(results.methods, (_label(*entry) for entry in entries.items()), strict=True)
    for track, (other, other_label) in product(dict.fromkeys(task.track for task, _ in results.tasks), others):
        pairs = results.paired(first, other, track)
        yield {
            "track": track,
            "methods": f"{label} - {other_label}",
            "difference (95 %)": _interval(pairs.difference, pairs.low, pairs.high, "+.3f"),
            "only one detected": f"{pairs.first} : {pairs.second}",
            "McNemar's p": f"{pairs.p:.2g}",
        }
