"""The model cards of all weights that ship (`bringup.model_card`).

``python -m benchmarks.model_cards`` writes docs/models; ``--check`` only says which cards are not up to date.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from benchmarks.paper import bodies, tables
from benchmarks.paper.runs import ALL, ROOT, distinct, is_stale, load
from bringup import model_card
from bringup.model_card import Place, Score
from mujoban_core.files import write_atomically
from mujoban_core.program import read_options, run_command
from mujoban_sim.presets import DEFAULT_WORLD

CARDS: Final = ROOT / "docs" / "models"
_PLACE: Final = Place(
    "python -m benchmarks.model_cards", "../",
    f"levels that no training saw, in the {DEFAULT_WORLD} world ([results](../results/README.md))",
)


def records() -> list[Path]:
    """Return the records of all weights that ship."""
    return sorted(ROOT.glob("mujoban_*/weights/*.json"))


def card(path: Path) -> str:
    """Return the model card for a record, with what the results say of its weights.

    Raises:
        CardError: If there is no text about its class.
    """
    weights = path.with_suffix(".safetensors").relative_to(ROOT)
    return model_card.card(path, str(weights), _PLACE, _scores(json.loads(path.read_text()).get("digest")))


def _scores(digest: str | None) -> list[Score]:
    return [
        Score(
            run.title, tables.privileged(run, report), len(report["episodes"]), report["success_rate"],
            report["success_interval"], is_stale(report, run),
        )
        for run in distinct((*bodies.RUNS, *ALL))
        if (report := load(run)) is not None and digest in report["weights"].values()
    ]


def stale() -> list[Path]:
    """Return the cards that are missing or not what their records say, and those whose weights are gone."""
    expected = {CARDS / f"{path.stem}.md": path for path in records()}
    found = set(CARDS.glob("*.md"))
    return sorted(
        {file for file, path in expected.items() if file not in found or file.read_text() != card(path)}
        | (found - expected.keys())
    )


PROG: Final = "benchmarks.model_cards"


@dataclass(frozen=True)
class Options:
    """What to do."""

    check: bool = False
    """Only say which cards are not up to date, with status 1 if there are any."""


def main(command_line: Sequence[str] | None = None) -> int:
    """Run the command."""
    options = read_options(Options, command_line, PROG, __doc__)
    old = stale()
    if not options.check:
        CARDS.mkdir(parents=True, exist_ok=True)
        for file in old:
            file.unlink(missing_ok=True)
        for path in records():
            write_atomically(CARDS / f"{path.stem}.md", card(path).encode())
    for file in old:
        print(f"{file.relative_to(ROOT)} {'is not up to date' if options.check else 'renewed'}")
    return int(options.check and bool(old))


if __name__ == "__main__":
    run_command(PROG, main)
