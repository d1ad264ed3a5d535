"""Judge the controller: `python -m mujoban_controller.evaluate --episodes 512 --seed 5000000`.

Whole episodes of a solver's plans with exact termination signals, or random instructions of every kind with
`--instructions random`, or how far it turns while it is told to stay with `--instructions stay`; prints JSON.
`--driver` compares the camera policy with the scripted driver or a privileged teacher under the same judgement, which
shows the loss from distillation.
"""

from __future__ import annotations

if __name__ == "__main__":
    from mujoban_core.early import end_at_once

    end_at_once()

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from mujoban_controller import camera_weights, teacher_weights
from mujoban_controller.controller import VisuomotorController
from mujoban_controller.drivers import Driver
from mujoban_controller.judge import judge
from mujoban_controller.privileged import PrivilegedPolicy
from mujoban_controller.scripted import scripted_driver
from mujoban_controller.turning import judge_turning
from mujoban_core.bodies import get_body
from mujoban_core.files import check_file, digest
from mujoban_core.plugins import PRIVILEGED, privileged_roles
from mujoban_core.program import read_options, run_command
from mujoban_core.reports import give_report
from mujoban_core.threads import set_threads
from mujoban_rl.sealed_levels import noted_use
from mujoban_rl.weights import load_weights
from mujoban_sim.oracles import OraclePlanner
from mujoban_sim.presets import DEFAULT_WORLD
from mujoban_sokoban.generator import VALIDATION_SEEDS, seed_range

PROG = "mujoban_controller.evaluate"


@dataclass(frozen=True)
class Options:
    """Judge the controller on instructions."""

    driver: Literal["camera", "teacher", "scripted"] = "camera"
    """Camera policy, privileged policy or scripted driver."""
    instructions: Literal["plans", "random", "stay"] = "plans"
    """A solver's plans; random moves, pushes, stays, and instructions towards walls and blocked boxes; or stays
    alone."""
    weights: Path | None = None
    """Weights of camera policy or teacher; those that ship by default."""
    episodes: int = 128
    seed: int = VALIDATION_SEEDS.start
    """Seed of the first level; level i has seed + i."""
    difficulty: int = 5
    body: str = "ball"
    world: str = DEFAULT_WORLD
    """The physical world: reference or eased."""
    batch: int = 64
    threads: int = 1
    device: str = "cpu"
    json: Path | None = None
    """File for the report instead of standard output."""

    def __post_init__(self) -> None:
        """Reject what cannot be judged."""
        get_body(self.body)  # refuses one that there is not
        if self.episodes < 1:
            raise ValueError(f"--episodes {self.episodes}: expected at least 1")
        if seed_range(self.seed, self.episodes) == "training":
            raise ValueError(f"--seed {self.seed}: expected seeds of validation or test, not of training")
        if self.driver == "scripted" and not get_body(self.body).scripted:
            raise ValueError(f"--driver scripted: no script drives --body {self.body}, expected camera or teacher")


def make_driver(options: Options) -> tuple[Driver, str]:
    """Return the driver and what identifies it: the digest of its weights, or its name, and that it is privileged."""
    if options.driver == "scripted":
        return scripted_driver, f"scripted{PRIVILEGED}"
    teacher = options.driver == "teacher"
    cls = PrivilegedPolicy if teacher else VisuomotorController
    weights = options.weights or (teacher_weights if teacher else camera_weights)(options.body)
    policy = load_weights(cls, weights, options.device, body=options.body)
    return policy.driver(), f"{digest(weights)}{PRIVILEGED if teacher else ''}"


def main(command_line: Sequence[str] | None = None) -> int:
    """Run the command."""
    options = read_options(Options, command_line, PROG, __doc__)
    check_file("--json", options.json)
    set_threads(options.threads)
    driver, identity = make_driver(options)
    levels: dict[str, Any] = {
        "episodes": options.episodes, "first_seed": options.seed, "difficulty": options.difficulty,
        "body": options.body, "world": options.world, "threads": options.threads,
    }  # fmt: skip
    if options.instructions == "stay":
        report = judge_turning(driver, **levels)
    else:
        plans = options.instructions == "plans"
        report = judge(driver, OraclePlanner(), **levels, batch=options.batch, plans=plans)
    weights = {"controller": identity}
    told: dict[str, Any] = {
        "weights": weights, "privileged": privileged_roles(weights), "world": options.world, "n": options.episodes,
        "seed": options.seed,
    }  # fmt: skip
    how = {name: getattr(options, name) for name in ("driver", "instructions", "difficulty", "body", "world")}
    seeds = range(options.seed, options.seed + options.episodes)
    told |= noted_use(seeds, weights, {"program": PROG, **how})
    give_report({**report, **told}, options.json)
    return 0


if __name__ == "__main__":
    run_command(PROG, main)
