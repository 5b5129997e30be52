"""The tables of a benchmark, as heads and lines of text, for a page or for Markdown."""

from __future__ import annotations  # so that `help` shows names of types instead of what they stand for

import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from jaxmark.bench.results import BenchResults
from jaxmark.bench.summary import NOT_VALIDATED, entries
from jaxmark.bench.work import COSTS

Entries = Mapping[str, dict[str, Any]]


class Table(NamedTuple):
    """A table of a page."""

    title: str
    heads: Sequence[str]
    lines: Sequence[Sequence[str]]
    remark: str = ""

    def markdown(self) -> str:
        """The table as Markdown, in columns that are as wide as what is in them."""
        rows = [list(self.heads), *map(list, self.lines)]
        rows = [[re.sub(r"\s+", " ", cell).replace("|", "\\|") for cell in row] for row in rows]
        text = [f"| {' | '.join(row)} |" for row in rows]
        text.insert(1, "|---" * len(self.heads) + "|")
        remark = ["", self.remark] if self.remark else []
        return "\n".join([f"## {self.title}", *remark, "", *text])


def tables(results: BenchResults) -> list[Table]:
    """All tables of a benchmark."""
    every = entries(results)
    several = len({payload for entry in every.values() for payload in entry["payloads"]}) > 1
    found = [_scores(every), _calibrations(every, results.rate)]
    payloads = sorted({payload for entry in every.values() for payload in entry["payloads"]}, key=int)
    for payload in payloads:
        some = {name: entry["payloads"][payload] for name, entry in every.items() if payload in entry["payloads"]}
        for league, limits in dict.fromkeys(
            (league, limits)
            for one in some.values()
            for league, parts in one["leagues"].items()
            for limits in parts["limits"]
        ):
            parts = {
                name: one["leagues"][league]["limits"][limits]
                for name, one in some.items()
                if limits in one["leagues"].get(league, {"limits": {}})["limits"]
            }
            bits = f", {payload} bits" if several else ""
            found += [_marks(f"{league}, {limits} limits{bits}: the marks", parts, every)]
            found += [_attacks(f"{league}, {limits} limits{bits}: what survives", parts, every)]
            found += [_costs(f"{league}, {limits} limits{bits}: what attacks do to the shape", parts)]
    found += [*_refused(every), *_paired(results, every)]
    if results.skipped:
        lines = [[name, why] for name, why in results.skipped.items()]
        found.append(Table("Skipped", ["attack", "why"], lines))
    return found


def _label(name: str, entry: Mapping[str, Any]) -> str:
    """A method's name, with a word on what is not validated, which stands in every table."""
    return f"{name} ({NOT_VALIDATED})" if entry["validated"] == NOT_VALIDATED else name


def _bits(entry: Mapping[str, Any], payload: str) -> str:
    """Bits of a message, of which a method may have none, or a number of its own."""
    if not entry["bits"]:
        return "-"
    return payload if len(entry["payloads"]) > 1 else str(entry["bits"])


def _number(value: float | None, digits: int = 3) -> str:
    return "-" if value is None else f"{value:.{digits}g}"


def _share(count: int, trials: int) -> str:
    return f"{count}/{trials}"


def _scores(entries: Entries) -> Table:
    lines = []
    for name, entry in entries.items():
        for payload, part in entry["payloads"].items():
            for league, found in part["leagues"].items():
                cells = [_label(name, entry), "blind" if entry["blind"] else "informed", _bits(entry, payload), league]
                for rule in ("detected", "read"):
                    one = found["scores"][rule]
                    if one is None or (rule == "read" and not entry["bits"]):
                        cells.append("-")
                    else:
                        cells.append(f"{one['value']:.2f} ({one['low']:.2f} - {one['high']:.2f})")
                one = found["scores"]["detected"]
                cells += [
                    _number((one or {"areas": {}})["areas"].get(metric), 2) for metric in ("mrms", "dame", "msdm2")
                ]
                lines.append([*cells, entry["validated"]])
    return Table(
        "Scores",
        ["method", "reader", "bits", "league", "detected", "read", "MRMS", "DAME", "MSDM2", "validated by"],
        lines,
        "Area under the share of marks that survive, over what the attack itself costs the shape (0 to 1), with 95 %"
        " intervals over meshes and seeds; the columns of metrics are its parts, of `detected`.",
    )


def _calibrations(entries: Entries, rate: float) -> Table:
    lines = []
    for name, entry in entries.items():
        for payload, part in entry["payloads"].items():
            found = part["calibration"]
            if found is None:
                continue
            own, bound = found["own_threshold"], [one for one in found["bound"] if one["hits"]]
            lines.append(
                [
                    _label(name, entry),
                    _bits(entry, payload),
                    ", ".join(f"{kind}: {_share(one['hits'], one['trials'])}" for kind, one in found["nulls"].items()),
                    _number(found["threshold"]),
                    f"{found['rate']:.2g} ({found['rate_low']:.2g} - {found['rate_high']:.2g})",
                    "-" if own is None else f"{_share(own['hits'], own['trials'])}, stated {own['stated']:g}",
                    "-"
                    if not found["bound"]
                    else ", ".join(f"10^{one['log10_p']:g}: {_share(one['hits'], one['trials'])}" for one in bound)
                    or f"never passed in {found['bound'][0]['trials']}",
                    f"{found['roc_area']:.3f}",
                    " ".join(found["verdicts"]) or "holds",
                ]
            )
    return Table(
        "Calibration",
        [
            "method",
            "bits",
            "nulls above the threshold",
            "threshold",
            "rate (95 %)",
            "nulls at its own threshold",
            "nulls that pass its bound",
            "ROC",
            "verdict",
        ],
        lines,
        f"Suspects without the key's mark, read by each reader. A mark counts as detected above the threshold whose"
        f" expected false-positive rate is at most {rate:g}; the interval is exact for nulls of one distribution.",
    )


def _marks(title: str, parts: Mapping[str, Any], entries: Entries) -> Table:
    names = ("rms", "mrms", "dame", "msdm2")
    lines = [
        [
            _label(name, entries[name]),
            _share(part["marks"]["made"], part["marks"]["tried"]),
            *(_number(part["marks"].get(metric)) for metric in names),
            _number(part["marks"]["seconds"], 2),
            "; ".join(part["marks"]["notes"]) or "-",
        ]
        for name, part in parts.items()
    ]
    return Table(title, ["method", "made", "RMS", "MRMS", "DAME", "MSDM2", "s", "remarks"], lines)


def _attacks(title: str, parts: Mapping[str, Any], entries: Entries) -> Table:
    attacks = list(dict.fromkeys(attack for part in parts.values() for attack in part["attacks"]))
    lines = []
    for attack in attacks:
        line, published = [attack], {}
        for name, part in parts.items():
            one = part["attacks"].get(attack)
            if one is None:
                line.append("-")
                continue
            published = one.get("published_bit_errors", published) or published
            cell = f"detected {_share(one['detected'], one['trials'])}"
            if entries[name]["bits"]:
                cell = f"{_share(one['read'], one['trials'])}, BER {one['bit_errors']:.2f}, {cell}"
            line.append(cell if one["log10_p"] is None else f"{cell}, p 10^{one['log10_p']:.1f}")
        lines.append([*line, *(f"{published[name]:.2f}" if name in published else "-" for name in ("cho", "wang"))])
    heads = ["attack", *(_label(name, entries[name]) for name in parts), "Cho, published", "Wang, published"]
    if all(line[-2:] == ["-", "-"] for line in lines):  # this league is younger than they are
        heads, lines = heads[:-2], [line[:-2] for line in lines]
    remark = (
        "How often the exact message is read; wrong bits of the best guess (BER), the mean; false-positive probability"
        " (p), the median, of methods that bound it."
    )
    return Table(title, heads, lines, remark)


def _costs(title: str, parts: Mapping[str, Any]) -> Table:
    """What attacks do to the mesh that the first method marked, the mean over meshes and seeds."""
    attacks = next(iter(parts.values()))["attacks"]
    lines = [[attack, *(_number(one["costs"][name]) for name in COSTS)] for attack, one in attacks.items()]
    return Table(title, ["attack", *(name.upper() for name in COSTS)], lines)


def _refused(entries: Entries) -> Iterator[Table]:
    """What methods and attacks said where nothing was read, and how often."""
    said: dict[tuple[str, str], list[str]] = defaultdict(list)
    for name, entry in entries.items():
        for part in entry["payloads"].values():
            for league, found in part["leagues"].items():
                for limits, under in found["limits"].items():
                    for attack, one in under["attacks"].items():
                        for note in one["notes"]:
                            said[_label(name, entry), note].append(f"{league}, {limits}: {attack}")
    if said:
        lines = [[name, note, str(len(where)), where[0]] for (name, note), where in said.items()]
        yield Table("Refused", ["method", "what was said", "after attacks", "the first"], lines)


def _paired(results: BenchResults, entries: Entries) -> Iterator[Table]:
    """The first method beside each other one, on the same suspects."""
    first, *others = results.methods
    labels = dict(zip(results.methods, (_label(name, entry) for name, entry in entries.items()), strict=True))
    leagues = dict.fromkeys(task.league for task, _ in results.tasks)
    lines = []
    for league in leagues:
        for other in others:
            found = results.paired(first, other, league)
            lines.append(
                [
                    league,
                    f"{labels[first]} - {labels[other]}",
                    f"{found.difference:+.3f} ({found.low:+.3f} - {found.high:+.3f})",
                    f"{found.first} : {found.second}",
                    f"{found.p:.2g}",
                ]
            )
    if lines:
        yield Table(
            "Pairs",
            ["league", "methods", "difference (95 %)", "only one of them", "McNemar's p"],
            lines,
            "Detected, on the same meshes, seeds, limits and attacks. Interval and p describe these suspects: many"
            " attacks of one mark are not independent of each other.",
        )
