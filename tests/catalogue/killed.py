"""Kill processes while they change a catalogue; what is left must be whole. A program: it forks, which JAX forbids."""

import os
import random
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path

import jaxmark as jm
from jaxmark.watermark.record import Record


def change(files: list[Path], record: Record) -> None:
    """Add, keep and remove without end, as several commands do."""
    number = 0
    while True:
        with jm.Catalogue("shop.db") as catalogue:
            for file in files:
                catalogue.add(file)
                catalogue.add_record(record)
                catalogue.record_verdict(f"{number:064x}", "suspect.ply", {"named": False, "number": number})
                number += 1
            with suppress(jm.JaxmarkError):  # the other process may have been faster
                catalogue.remove(str(files[-1]))


def check(files: list[Path]) -> None:
    """Every original has its meshes, and nothing refers to what is missing."""
    with jm.Catalogue("shop.db") as catalogue:
        assert not catalogue.database.problems()
        (row,) = catalogue.database.rows(
            "SELECT count(*) AS bare FROM originals WHERE id NOT IN (SELECT original FROM shapes)"
        )
        assert row["bare"] == 0
        assert len(catalogue.originals()) <= len(files)
        for verdict in catalogue.verdicts():
            assert verdict["suspect"] == f"{verdict['result']['number']:064x}"


def main(kills: int) -> None:
    files = sorted(Path().glob("*.obj"))
    record = Record.load("record.json")
    with jm.Catalogue("shop.db") as catalogue:
        catalogue.add(files[0])
    chance = random.Random(0)
    for _ in range(kills):
        children = []
        for _ in range(2):
            child = os.fork()
            if child == 0:
                try:
                    change(files, record)
                finally:
                    os._exit(1)
            children.append(child)
        time.sleep(chance.uniform(0, 0.5))
        for child in children:
            os.kill(child, signal.SIGKILL)
            _, status = os.waitpid(child, 0)
            assert os.WIFSIGNALED(status), "it ended by itself"
        check(files)
    with jm.Catalogue("shop.db") as catalogue:
        print(f"{2 * kills} processes killed, {len(list(catalogue.verdicts()))} verdicts kept")


if __name__ == "__main__":
    main(int(sys.argv[1]))
