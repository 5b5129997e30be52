"""Tables of a benchmark as text, for a page or for Markdown."""

from __future__ import annotations  # so that `help` shows names of types instead of what they stand for

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
    found = [
        _table(
            "Scores",
            _scores(every),
            "Area under the share of marks that survive, over what the attack itself costs the shape (0 to 1), with"
            " 95 % intervals over meshes and seeds; the columns of metrics are its parts, of `detected`.",
        ),
        _table(
            "Calibration",
            _calibrations(every),
            "Suspects without the key's mark, read by each reader. A mark counts as detected above the threshold whose"
            f" expected false-positive rate is at most {results.rate:g}; the interval is exact for nulls of one"
            " distribution.",
        ),
    ]
    for (payload, track, limits), parts in groups.items():
        title = f"{track}, {limits} limits{f', {payload} bits' if several else ''}"
        found += [
            _table(f"{title}: the marks", _marks(parts, every)),
            _attacks(f"{title}: what survives", parts, every),
            _table(f"{title}: what attacks do to the shape", _costs(parts)),
        ]
    paired_remark = (
        "Detected, on the same meshes, seeds, limits and attacks. Interval and p describe these suspects: many attacks"
        " of one mark are not independent of each other."
    )
    skipped = ({"attack": name, "why": why} for name, why in results.skipped.items())
    rest = [
        _table("Refused", _refused(groups, every)),
        _table("Pairs", _paired(results, every), paired_remark),
        _table("Skipped", skipped),
    ]
    return found + [table for table in rest if table.lines]


Row = Mapping[str, str]  # cells by the heads of their columns


def _table(title: str, rows: Iterable[Row], note: str = "") -> Table:
    listed = list(rows)
    return Table(title, list(listed[0]) if listed else [], [list(row.values()) for row in listed], note)


def _groups(entries: Entries) -> dict[tuple[str, str, str], dict[str, Any]]:
    """Group the parts of all methods by payload, track and limits."""
    groups: dict[tuple[str, str, str], dict[str, Any]] = defaultdict(dict)
    for payload in sorted({payload for entry in entries.values() for payload in entry["payloads"]}, key=int):
        for name, entry in entries.items():
            for track, found in entry["payloads"].get(payload, {"tracks": {}})["tracks"].items():
                for limits, part in found["limits"].items():
                    groups[payload, track, limits][name] = part
    return groups


def _label(name: str, entry: Mapping[str, Any]) -> str:
    """A method's name, marked in every table if the method is not validated."""
    return f"{name} ({NOT_VALIDATED})" if entry["validated"] == NOT_VALIDATED else name


def _payloads(entries: Entries) -> Iterator[tuple[str, str, Mapping[str, Any], Mapping[str, Any]]]:
    """Yield label, bits, entry and part of each method at each payload; a method may have bits of its own, or none."""
    for name, entry in entries.items():
        for payload, part in entry["payloads"].items():
            bits = payload if len(entry["payloads"]) > 1 else str(entry["bits"])
            yield _label(name, entry), bits if entry["bits"] else "-", entry, part


def _number(value: float | None, form: str = ".3g") -> str:
    return "-" if value is None else f"{value:{form}}"


def _interval(value: float, low: float, high: float, form: str) -> str:
    return f"{value:{form}} ({low:{form}} - {high:{form}})"


def _share(found: Mapping[str, Any], of: str = "hits") -> str:
    return f"{found[of]}/{found['trials']}"


def _scores(entries: Entries) -> Iterator[Row]:
    for label, bits, entry, part in _payloads(entries):
        for track, found in part["tracks"].items():
            row = {"method": label, "reader": "blind" if entry["blind"] else "informed", "bits": bits, "track": track}
            for rule, one in found["scores"].items():
                row[rule] = "-"
                if one is not None and (rule == "detected" or entry["bits"]):
                    row[rule] = _interval(one["value"], one["low"], one["high"], ".2f")
            areas = (found["scores"]["detected"] or {"areas": {}})["areas"]
            row |= {metric.upper(): _number(areas.get(metric), ".2g") for metric in COSTS}
            yield {**row, "validated by": entry["validated"]}


def _calibrations(entries: Entries) -> Iterator[Row]:
    for label, bits, _, part in _payloads(entries):
        if (found := part["calibration"]) is None:
            continue
        own, bound = found["own_threshold"], found["bound"]
        passed = ", ".join(f"10^{one['log10_p']:g}: {_share(one)}" for one in bound if one["hits"])
        yield {
            "method": label,
            "bits": bits,
            "nulls above the threshold": ", ".join(f"{kind}: {_share(one)}" for kind, one in found["nulls"].items()),
            "threshold": _number(found["threshold"]),
            "rate (95 %)": _interval(found["rate"], found["rate_low"], found["rate_high"], ".2g"),
            "nulls at its own threshold": f"{_share(own)}, stated {own['stated']:g}" if own else "-",
            "nulls that pass its bound": (passed or f"never passed in {bound[0]['trials']}") if bound else "-",
            "ROC": f"{found['roc_area']:.3f}",
            "verdict": " ".join(found["verdicts"]) or "holds",
        }


def _marks(parts: Mapping[str, Any], entries: Entries) -> Iterator[Row]:
    for name, part in parts.items():
        marks = part["marks"]
        row = {"method": _label(name, entries[name]), "made": f"{marks['made']}/{marks['tried']}"}
        row |= {metric.upper(): _number(marks.get(metric)) for metric in ("rms", *COSTS)}
        yield {**row, "s": _number(marks["seconds"], ".2g"), "notes": "; ".join(marks["notes"]) or "-"}


def _attacks(title: str, parts: Mapping[str, Any], entries: Entries) -> Table:
    def cell(name: str, one: Mapping[str, Any] | None) -> str:
        if one is None:
            return "-"
        said = [f"{_share(one, 'read')}, BER {one['bit_errors']:.2f}"] if entries[name]["bits"] else []
        said += [f"detected {_share(one, 'detected')}"]
        return ", ".join(said if one["log10_p"] is None else [*said, f"p 10^{one['log10_p']:.1f}"])

    lines = []
    for attack in dict.fromkeys(attack for part in parts.values() for attack in part["attacks"]):
        found = {name: part["attacks"].get(attack) for name, part in parts.items()}
        published = next((p for one in found.values() if one and (p := one.get("published_bit_errors"))), {})
        line = [attack, *(cell(name, one) for name, one in found.items())]
        lines.append([*line, *(_number(published.get(name), ".2f") for name in ("cho", "wang"))])
    heads = ["attack", *(_label(name, entries[name]) for name in parts), "Cho, published", "Wang, published"]
    if all(line[-2:] == ["-", "-"] for line in lines):  # this track is younger than they are
        heads, lines = heads[:-2], [line[:-2] for line in lines]
    note = (
        "How often the exact message is read; wrong bits of the best guess (BER), the mean; false-positive probability"
        " (p), the median, of methods that bound it."
    )
    return Table(title, heads, lines, note)


def _costs(parts: Mapping[str, Any]) -> Iterator[Row]:
    """Tabulate the distortion of the mesh that the first method marked, the mean over meshes and samples."""
    for attack, one in next(iter(parts.values()))["attacks"].items():
        yield {"attack": attack, **{name.upper(): _number(one["costs"][name]) for name in COSTS}}


def _refused(groups: Mapping[tuple[str, str, str], Mapping[str, Any]], entries: Entries) -> Iterator[Row]:
    """Tabulate refusals by methods and attacks, and their number."""
    places: dict[tuple[str, str], list[str]] = defaultdict(list)
    for name, entry in entries.items():
        for (_, track, limits), parts in groups.items():
            for attack, one in parts.get(name, {"attacks": {}})["attacks"].items():
                for note in one["notes"]:
                    places[_label(name, entry), note].append(f"{track}, {limits}: {attack}")
    for (label, note), where in places.items():
        yield {"method": label, "what was said": note, "after attacks": str(len(where)), "the first": where[0]}


def _paired(results: BenchResults, entries: Entries) -> Iterator[Row]:
    """Compare the first method with each other one, on the same suspects."""
    (first, label), *others = zip(results.methods, (_label(*entry) for entry in entries.items()), strict=True)
    for track, (other, other_label) in product(dict.fromkeys(task.track for task, _ in results.tasks), others):
        found = results.paired(first, other, track)
        yield {
            "track": track,
            "methods": f"{label} - {other_label}",
            "difference (95 %)": _interval(found.difference, found.low, found.high, "+.3f"),
            "only one of them": f"{found.first} : {found.second}",
            "McNemar's p": f"{found.p:.2g}",
        }
