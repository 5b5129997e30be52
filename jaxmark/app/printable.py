"""Text for a terminal: names in it, which a stranger may have chosen, cannot act on the terminal or begin a line."""


def printable(line: str) -> str:
    r"""Replace the characters of a line that cannot be printed by escapes, as `repr` does: `\n`, `\x1b`, `\u202e`."""
    return "".join(char if char.isprintable() else char.encode("unicode_escape").decode() for char in line)
