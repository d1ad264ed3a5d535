"""MPO over moves (paper C.2): actors play the time-abstracted task, and a learner fits policy and Q head.

An actor plays hundreds of levels at once. A failed instruction's experience is dropped and ends the abstract episode
early. Recorded bags of the running stack may add their instruction-level transitions to the batches.

Shapes: B batch, N = `grid.GRID_SIZE`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Final

import torch

from mujoban_core.grid import Instruction
from mujoban_core.ranges import check_counts, check_not_negative, check_positive
from mujoban_msgs_py.bags.training import bags_digest, check_batch_share
from mujoban_planner.bag_transitions import BagTransitions
from mujoban_planner.discrete_mpo import MPOBatch, StepStore
from mujoban_planner.growth import beginning, begun_with
from mujoban_planner.heads import silence_verdicts
from mujoban_planner.move_learner import MoveLearner
from mujoban_planner.moves import MoveActor, MoveConfig
from mujoban_planner.planner import LearnedPlanner
from mujoban_planner.product import PlannerLearner
from mujoban_planner.validation import NetworkConfig
from mujoban_rl.actors import ActorOptions, ActorSource
from mujoban_rl.engine import Budget, Cadence, Source, State, Trainer
from mujoban_rl.run_directory import RunDirectory
from mujoban_rl.weights import lineage, provenance, usable_device

MPO_PACE: Final = {"log_updates": 50, "publish_updates": 5}
"""How often a run logs and publishes."""
_PLAYED: Final = "abstract environment on generated levels, training seeds"


@dataclass(frozen=True)
class MPOConfig(MoveConfig, NetworkConfig):
    """What defines an MPO run."""

    teach_pushes: bool = False
    """Teach the push head, by which the policy goes, as well; otherwise the policy only follows it."""
    anchor: float = 0.0
    """How much it counts that the verdicts of weights to start from go on saying what they said; 0 lets them drift."""
    critic_first: int = 0
    """Updates in which the critic's head learns alone: weights to start from that are good need it."""
    bag_share: float = 0.25
    """Share of a batch that comes from bags, where there are any; 1: all, and nothing is played."""
    cpu_seconds: float = 1e9
    """CPU seconds of all processes after which the run is complete."""

    def __post_init__(self) -> None:
        """Reject what is no share, and a budget of nothing."""
        MoveConfig.__post_init__(self)
        NetworkConfig.__post_init__(self)
        check_positive(self, "cpu_seconds")
        check_not_negative(self, "anchor")
        check_counts(self, "critic_first", least=0)
        check_batch_share(self.bag_share)


class MoveStore(StepStore):
    """Replay of what actors played, beside the transitions of recorded bags."""

    def __init__(self, config: MPOConfig, bags: BagTransitions | None = None) -> None:
        """Start empty."""
        super().__init__(config)
        self._share, self._bags = config.bag_share, bags

    def sample(self) -> MPOBatch:
        """Return a batch with n-step returns."""
        config = self._config
        if self._bags is None:
            return self._played(config.batch_size)
        from_bags = max(1, int(config.batch_size * self._share))
        played = self._played(config.batch_size - from_bags)
        recorded = recorded_batch(self._bags, from_bags, config.discount, self.generator)
        return MPOBatch._make(torch.cat(columns) for columns in zip(played, recorded, strict=True))


def recorded_batch(bags: BagTransitions, count: int, discount: float, generator: torch.Generator) -> MPOBatch:
    """Return random transitions of bags with returns of one step."""
    found = bags.sample(count, generator)
    bootstrap = discount * (~found.terminated).float()
    valid = torch.ones_like(found.terminated)
    return MPOBatch(found.state, found.instruction, found.reward, bootstrap, found.next_state, valid)


class RecordedMoves(Source[MPOBatch]):
    """Batches of recorded transitions, and of nothing else."""

    def __init__(self, config: MPOConfig, bags: BagTransitions) -> None:
        """Draw from `bags`."""
        self._config, self._bags = config, bags
        self._generator = torch.Generator().manual_seed(config.seed)

    def next_batch(self) -> MPOBatch:
        """Return a batch."""
        self.samples += self._config.batch_size
        return recorded_batch(self._bags, self._config.batch_size, self._config.discount, self._generator)

    def state(self) -> State:
        """Return what draws."""
        return State(tensors={"generator": self._generator.get_state()})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        self._generator.set_state(state.tensors["generator"])


class MPOLearner(PlannerLearner[MPOBatch], MoveLearner):
    """A planner that learns over moves."""

    def __init__(
        self, config: MPOConfig, *, device: torch.device | str = "cpu", init: Path | None = None
    ) -> None:
        """Begin with the weights of a planner that imitated, for instance, or with a new network (`beginning`)."""
        place = usable_device(device)
        torch.manual_seed(config.seed)  # the initial weights
        network = beginning(config, init).to(place)
        if init is None:
            silence_verdicts(network.heads)
        else:
            reset_stay_logit(network)
        super().__init__(
            config, network, place, teach_pushes=config.teach_pushes, anchor=config.anchor,
            critic_first=config.critic_first,
        )  # fmt: skip

    @property
    def product(self) -> LearnedPlanner:
        """The target network."""
        return self.target


def reinforcement(
    config: MPOConfig,
    directory: Path,
    cadence: Cadence | None = None,
    *,
    device: str = "cpu",
    actors: ActorOptions | None = None,
    init: Path | None = None,
    bags: Sequence[Path] = (),
) -> Trainer[MPOBatch]:
    """Open or resume a run.

    Args:
        config: What to train; fixed for the run.
        directory: Run directory.
        cadence: How often it publishes, evaluates and saves.
        device: Device of the learner, and of actors that share its process.
        actors: Where actors play; by default in this process, by turns with the learner.
        init: Weights to start from, for example of one that imitated, of the same or fewer channels and blocks.
        bags: Directories of recorded bags whose transitions join the batches.

    Raises:
        ValueError: If the directory belongs to another run, or device, weights or a bag are not what is expected.
    """
    origin = begun_with(init)
    run = RunDirectory(directory, config, beside={"init": origin})
    recorded = BagTransitions.read(bags) if bags else None
    learner = MPOLearner(config, device=device, init=init)
    if recorded is not None and config.bag_share == 1.0:
        source: Source[MPOBatch] = RecordedMoves(config, recorded)
    else:
        source = _played(config, learner.network, actors or ActorOptions(), device, recorded)
    data = "bags" if isinstance(source, RecordedMoves) else _PLAYED + (" and bags" if bags else "")
    record = {
        **provenance(),
        "method": "mpo",
        "training": asdict(config),
        "init": origin,
        "data": lineage(data, init),
        "bags_digest": bags_digest(bags),
    }
    return Trainer(run, learner, source, Budget(cpu_seconds=config.cpu_seconds), cadence, record=record)


def _played(
    config: MPOConfig, network: LearnedPlanner, options: ActorOptions, device: str, recorded: BagTransitions | None
) -> Source[MPOBatch]:
    """Return what actors play, beside the transitions of bags."""
    place = device if options.actors in ("local", "threads") else "cpu"
    pool = options.pool(partial(MoveActor, config, type(network), network.config, device=place))
    return ActorSource(
        pool, MoveStore(config, recorded), steps_per_update=config.steps_per_update * config.environments,
        first_steps=config.warm_up_steps * config.environments,
    )  # fmt: skip


@torch.no_grad()
def reset_stay_logit(network: LearnedPlanner) -> None:
    """Let a network that imitated, and never saw STAY, treat it as little less than the mean of the moves.

    Its logit was pushed to where exploration would never find out what STAY is worth.
    """
    head = network.heads.policy
    head.weight[Instruction.STAY] = head.weight[1:].mean(0)
    head.bias[Instruction.STAY] = head.bias[1:].mean() - 2.0
