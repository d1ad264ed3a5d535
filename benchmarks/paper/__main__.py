"""Rebuild every table and figure in docs/results/ from the JSON of the evaluations: `make results`."""

from __future__ import annotations

from pathlib import Path

from benchmarks.paper import figures, tables
from benchmarks.paper.runs import CONFIGURATIONS, DIFFICULTY, RESULTS, SEED

INTRODUCTION = f"""# Results

Rebuilt by `make results` from the JSON in `json/`, which `python -m benchmarks.paper.runs` writes by running
`bringup/evaluate.py` on n levels of the generator with seeds from {SEED} on, never used in training (paper: n = 512).
Intervals are 95 % Wilson intervals of the success rate. A row marked † was measured with other weights than those
that ship now.
"""


def main(folder: Path = RESULTS) -> None:
    """Write README.md and the figures."""
    folder.mkdir(parents=True, exist_ok=True)
    sections = [
        INTRODUCTION,
        "## Table 2: module evaluation\n",
        "The first row is also the modular row of Table 1.\n",
        tables.configurations(CONFIGURATIONS),
        "## Why episodes fail\n",
        tables.failures(CONFIGURATIONS),
        "## Figure 2: success against difficulty\n",
        tables.configurations(DIFFICULTY),
    ]
    if figures.difficulty(DIFFICULTY, folder / "figure2.png"):
        sections.append("![Success rate against difficulty](figure2.png)\n")
    if figures.curves(folder / "figure4.png"):
        sections += ["## Figure 4: learning curves\n", "![Learning curves of the modules](figure4.png)\n"]
    (folder / "README.md").write_text("\n".join(sections))


if __name__ == "__main__":
    main()
