"""The picture of what flows between the modules of the package, drawn from a list of boxes and arrows."""

from tests import ROOT

FIGURE = ROOT / "docs" / "data_flow.svg"
WIDE, ACROSS, DOWN, LINE = 290, 345, 150, 17  # of a box, from one to the next, and of a line of text

#: Name of each box, its column and row, its title, and the modules and packages that it stands for, by lines.
BOXES: dict[str, tuple[int, int, str, tuple[str, ...]]] = {
    "original": (0, 0, "the original, prepared", ("files mesh canonical", "padding original")),
    "filters": (1, 0, "filters", ("laplacian chebyshev product", "rational bands spectrum")),
    "key": (2, 0, "key and message", ("keys sequences", "polar message")),
    "budget": (0, 1, "as strong as the budget allows", ("budget visibility masking", "capacity distortion")),
    "carriers": (1, 1, "carriers of the bits", ("carriers components", "schemes keyed modulated")),
    "blind writing": (2, 1, "blind marks, written", ("anchors dither", "field local writing")),
    "marked": (0, 2, "marked mesh and record", ("markers mark", "record tracing imprint")),
    "reading": (1, 2, "soft values of the bits", ("observation reception", "detectors coarse bits")),
    "evidence": (2, 2, "message and evidence", ("bounds ledger", "detection")),
    "attacks": (0, 3, "what happens to it", ("attacks", "adversaries")),
    "alignment": (1, 3, "alignment with the original", ("suspect attempts features", "registration replay nonrigid")),
    "blind reading": (2, 3, "blind marks, read", ("search", "dither reading")),
}

#: From which box to which, and what flows.
ARROWS = (
    ("original", "filters", "operator"),
    ("original", "budget", "points"),
    ("filters", "carriers", "bands"),
    ("key", "carriers", "signs, code bits"),
    ("key", "blind writing", "dither, code bits"),
    ("carriers", "budget", "unit"),
    ("budget", "marked", "displacement"),
    ("blind writing", "marked", "displacement"),
    ("marked", "attacks", "marked mesh"),
    ("attacks", "alignment", "suspect"),
    ("alignment", "reading", "residual"),
    ("carriers", "reading", "carrier"),
    ("reading", "evidence", "scores"),
    ("blind reading", "evidence", "soft values, scores"),
)
AROUND = "around it", "evaluation plot catalogue bench app"
HEAD = """\
<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 1000 700" role="img" aria-label="What flows between the modules">
  <style>
    text { font: 13px sans-serif; text-anchor: middle; fill: #222 }
    .title { font-weight: bold }
    .modules { font-family: monospace; font-size: 12px }
    .data { font-size: 11px; font-style: italic; fill: #555; paint-order: stroke; stroke: white; stroke-width: 4px }
    .box { fill: #eef3fa; stroke: #4a6fa5 }
    .aside { fill: #f5f5f5; stroke: #999 }
    .arrow { fill: none; stroke: #4a6fa5; stroke-width: 1.5; marker-end: url(#head) }
  </style>
  <defs>
    <marker id="head" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="7" markerHeight="7" orient="auto">
      <path d="M0 0 L8 4 L0 8 z" fill="#4a6fa5"/>
    </marker>
  </defs>
  <rect width="1000" height="700" fill="white"/>
"""
HIGH = 32 + 2 * LINE  # of a box


def draw() -> str:
    """The picture as SVG."""
    parts = [_box(10 + ACROSS * x, 20 + DOWN * y, WIDE, title, lines) for x, y, title, lines in BOXES.values()]
    parts += [_arrow(*BOXES[start][:2], *BOXES[end][:2], label) for start, end, label in ARROWS]
    low = 20 + DOWN * 3 + HIGH
    column = [10 + ACROSS * x + WIDE / 2 for x in range(3)]
    parts.append(_path(f"M{column[0]:g} {low} V{low + 34} H{column[2]:g} V{low}"))
    parts.append(_label(column[1], low + 30, "suspect, read without the original"))
    parts.append(_box(10, low + 64, 980, AROUND[0], AROUND[1:], "aside"))
    return HEAD + "".join(f"  {part}\n" for part in parts) + "</svg>\n"


def _box(x: float, y: float, wide: float, title: str, lines: tuple[str, ...], kind: str = "box") -> str:
    middle, high = x + wide / 2, 32 + LINE * len(lines)
    texts = [f'<text class="title" x="{middle:g}" y="{y + 20:g}">{title}</text>']
    for number, line in enumerate(lines):
        texts.append(f'<text class="modules" x="{middle:g}" y="{y + 39 + LINE * number:g}">{line}</text>')
    return f'<rect class="{kind}" x="{x:g}" y="{y:g}" width="{wide:g}" height="{high}" rx="6"/>' + "".join(texts)


def _arrow(x: int, y: int, to_x: int, to_y: int, label: str) -> str:
    """An arrow between boxes side by side, one below the other, or from the right to the left of the next row."""
    left, top, to_left, to_top = (10 + ACROSS * x, 20 + DOWN * y, 10 + ACROSS * to_x, 20 + DOWN * to_y)
    if y == to_y:
        start, end = (left + WIDE * (to_x > x), top + HIGH / 2), (to_left + WIDE * (x > to_x), top + HIGH / 2)
    elif x == to_x:
        start, end = (left + WIDE / 2, top + HIGH * (to_y > y)), (left + WIDE / 2, to_top + HIGH * (y > to_y))
    else:
        start, end = (left + 30, top + HIGH), (to_left + WIDE - 30 / (x - to_x), to_top)
    across, down = (start[0] + end[0]) / 2, (start[1] + end[1]) / 2 + 4
    return _path(f"M{start[0]:g} {start[1]:g} L{end[0]:g} {end[1]:g}") + _label(across, down - 8 * (y == to_y), label)


def _path(d: str) -> str:
    return f'<path class="arrow" d="{d}"/>'


def _label(x: float, y: float, text: str) -> str:
    return f'<text class="data" x="{x:g}" y="{y:g}">{text}</text>'
