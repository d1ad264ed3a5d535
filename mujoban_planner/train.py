"""Train the planner: `python -m mujoban_planner.train imitation --run runs/planner`."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import torch
import tyro

from mujoban_planner.imitation import ImitationConfig, ImitationTrainer


@dataclass(frozen=True)
class Imitation:
    """Imitate the solver."""

    run: Path = Path("runs/planner")
    """Run directory; an existing one is resumed."""
    device: str = "cpu"
    """Device of the network."""
    seconds: float | None = None
    """Stop after so many seconds; a later call resumes."""
    samples: float = 1e12
    """Stop at so many samples; a later call resumes."""
    evaluate_every: float = 300.0
    """Seconds between evaluations on held-out levels."""
    save_every: float = 120.0
    """Seconds between checkpoints."""
    threads: int = 1
    """Threads of the network on a CPU."""
    processes: int = 1
    """Processes that make lessons: 1, or 0 for a deterministic run."""
    config: Annotated[ImitationConfig, tyro.conf.arg(name="")] = field(default_factory=ImitationConfig)

    def main(self) -> None:
        """Train."""
        torch.set_num_threads(self.threads)
        trainer = ImitationTrainer(self.config, self.run, device=self.device, processes=self.processes)
        trainer.run(
            seconds=self.seconds,
            samples=self.samples,
            evaluate_every=self.evaluate_every,
            save_every=self.save_every,
        )


def main() -> None:
    """Run the command line."""
    command = tyro.cli(Imitation)
    try:
        command.main()
    except ValueError as error:
        print(f"train: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
