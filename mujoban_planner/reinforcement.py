"""MPO over moves (paper C.2): actors play the time-abstracted task, and a learner fits policy and Q head.

An actor plays hundreds of levels at once; n-step returns off-policy from a replay train the Q head, discrete MPO the
policy head. A failed instruction's experience is dropped and ends the abstract episode early. Recorded bags of the
running stack may add their instruction-level transitions to the batches.

Shapes: B batch, N = `grid.GRID_SIZE`.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from mujoban_core.grid import Instruction
from mujoban_planner.bag_transitions import BagTransitions
from mujoban_planner.moves import MoveActor, PlayConfig
from mujoban_planner.planner import LearnedPlanner
from mujoban_planner.teacher import DISCOUNT
from mujoban_planner.validation import NetworkConfig, solve_rates
from mujoban_rl.actors import ActorOptions, ActorSource, Experience
from mujoban_rl.engine import Budget, Cadence, Learner, Source, State, Trainer
from mujoban_rl.limits import NaNGuard
from mujoban_rl.losses.mpo import scalars
from mujoban_rl.losses.mpo_discrete import DiscreteMPO, DiscreteMPOConfig, expected_value
from mujoban_rl.losses.returns import windowed_returns
from mujoban_rl.optimise import guarded_step
from mujoban_rl.replay import SequenceReplay
from mujoban_rl.run_directory import RunDirectory
from mujoban_rl.weights import digest, provenance, save_weights

_CLIP: Final = 40.0
"""Largest norm of the gradient."""
_PLAYED: Final = "abstract environment on generated levels, training seeds"


@dataclass(frozen=True)
class MPOConfig(PlayConfig, NetworkConfig):
    """What defines an MPO run."""

    mpo: DiscreteMPOConfig = field(default_factory=DiscreteMPOConfig)
    steps_per_update: float = 1.0
    """Instructions in each of `environments` levels per update."""
    replay_steps: int = 400
    """Instructions in each of `environments` levels that are kept."""
    warm_up_steps: int = 40
    """Instructions in each of `environments` levels before the first update."""
    batch_size: int = 256
    discount: float = DISCOUNT
    learning_rate: float = 1e-4
    dual_learning_rate: float = 1e-2
    target_period: int = 100
    """Updates between copies to the target network."""
    q_weight: float = 0.5
    """Weight of the critic's loss."""
    bag_share: float = 0.25
    """Share of a batch that comes from bags, where there are any; 1: all, and nothing is played."""

    def __post_init__(self) -> None:
        """Reject what is no share."""
        if not 0.0 < self.bag_share <= 1.0:
            raise ValueError(f"--bag-share {self.bag_share}: expected a share above 0, at most 1")


class MPOBatch(NamedTuple):
    """Instructions that were executed, with what came of them."""

    state: Tensor
    """Abstract states, float32 [B, N, N, 4]."""
    instruction: Tensor
    """int64 [B]."""
    reward: Tensor
    """Discounted reward of up to n instructions, float32 [B]."""
    bootstrap: Tensor
    """Discount of the value of `last`, 0 where the level was solved, float32 [B]."""
    last: Tensor
    """Abstract states from which the value goes on, float32 [B, N, N, 4]."""
    valid: Tensor
    """False where the instruction failed, bool [B]."""

    def to(self, device: torch.device) -> MPOBatch:
        """Return the batch on a device."""
        return MPOBatch._make(values.to(device, non_blocking=True) for values in self)


class MoveStore:
    """Replay of what actors played, beside the transitions of recorded bags."""

    def __init__(self, config: MPOConfig, bags: BagTransitions | None = None) -> None:
        """Start empty."""
        self._config, self._bags = config, bags
        length = config.play + config.n_step
        self.replay = SequenceReplay(max(1, config.replay_steps * config.environments // config.play), length)
        self._generator = torch.Generator().manual_seed(config.seed)

    def add(self, experience: Experience) -> None:
        """Take in a sequence of each of an actor's levels."""
        self.replay.add(experience.arrays)

    def sample(self) -> MPOBatch:
        """Return a batch with n-step returns."""
        config = self._config
        from_bags = 0 if self._bags is None else int(config.batch_size * config.bag_share)
        played = self._played(config.batch_size - from_bags)
        if self._bags is None or not from_bags:
            return played
        recorded = recorded_batch(self._bags, from_bags, config.discount, self._generator)
        return MPOBatch._make(torch.cat(columns) for columns in zip(played, recorded, strict=True))

    def _played(self, count: int) -> MPOBatch:
        window = self.replay.sample(count, self._generator, self._config.n_step + 1)
        reward, terminated, dropped = (window[name][:, :-1] for name in ("reward", "terminated", "dropped"))
        returns = windowed_returns(reward, terminated, dropped, self._config.discount)
        last = window["state"][torch.arange(count), returns.index]
        state, instruction = window["state"][:, 0].float(), window["instruction"][:, 0]
        return MPOBatch(state, instruction, returns.reward, returns.bootstrap, last.float(), returns.valid)

    def state(self) -> State:
        """Return the replay and what draws from it."""
        own = State(tensors={"generator": self._generator.get_state()})
        return State.of({"own": own, "replay": self.replay.state()})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        self._generator.set_state(state.part("own").tensors["generator"])
        self.replay.restore(state.part("replay"))


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


class MPOLearner(Learner[MPOBatch]):
    """Online and target network, and the dual variables."""

    def __init__(
        self, config: MPOConfig, *, device: torch.device | str = "cpu", init: LearnedPlanner | None = None
    ) -> None:
        """Begin with a network that imitated, of the configuration's architecture, or with a new one."""
        self.config, self.device = config, torch.device(device)
        torch.manual_seed(config.seed)  # the initial weights
        self.network = (init or config.build()).to(self.device).train()
        if init is None:
            silence_verdicts(self.network)
        else:
            reset_stay_logit(self.network)
        self.target = copy.deepcopy(self.network).eval()
        self.mpo = DiscreteMPO(config.mpo).to(self.device)
        self._adam = torch.optim.Adam(self.network.parameters(), config.learning_rate)
        self._dual_adam = self.mpo.duals.adam(config.dual_learning_rate)
        self._updates = 0

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        """Both networks and the dual variables."""
        return {"network": self.network, "target": self.target, "mpo": self.mpo}

    @property
    def optimisers(self) -> Mapping[str, torch.optim.Optimizer]:
        """Those of the network and of the dual variables."""
        return {"adam": self._adam, "duals": self._dual_adam}

    def state(self) -> State:
        """Return the number of updates, by which the target network follows."""
        return State({"updates": self._updates})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        self._updates = state.values["updates"]

    def update(self, batch: MPOBatch, progress: float, guard: NaNGuard) -> dict[str, float]:
        """Take one gradient step of policy, critic and dual variables."""
        config, batch = self.config, batch.to(self.device)
        with torch.no_grad(), self._autocast():
            before, after = self.target(batch.state), self.target(batch.last)
        target = batch.reward + batch.bootstrap * expected_value(after.q, after.policy)
        with self._autocast():
            output = self.network(batch.state)
        policy_loss, stats = self.mpo(output.policy, before.policy, before.q)
        taken = output.q.gather(1, batch.instruction[:, None])[:, 0]
        errors = functional.smooth_l1_loss(taken, target, reduction="none")
        q_loss = (errors * batch.valid).sum() / batch.valid.sum().clamp(min=1)
        guarded_step(policy_loss + config.q_weight * q_loss, [self._adam, self._dual_adam], guard, clip=_CLIP)
        self._updates += 1
        if self._updates % config.target_period == 0:
            self.target.load_state_dict(self.network.state_dict())
        return {"q_loss": q_loss.item(), "mean_reward": batch.reward.mean().item()} | scalars(stats._asdict())

    def _autocast(self) -> torch.autocast:
        return torch.autocast(self.device.type, torch.bfloat16)

    def weights(self) -> Mapping[str, Tensor]:
        """Return the online network, which actors play with."""
        return self.network.state_dict()

    def evaluate(self) -> dict[str, float]:
        """Return solve rates of the target network on held-out levels."""
        return solve_rates(self.target, reduced_precision=self.device.type == "cpu")

    def export(self, directory: RunDirectory, record: Mapping[str, Any]) -> None:
        """Write the target network with its record."""
        save_weights(directory.path / "planner.safetensors", self.target, self.target.config, record)


def reinforcement(
    config: MPOConfig,
    directory: Path,
    cadence: Cadence | None = None,
    *,
    device: str = "cpu",
    actors: ActorOptions | None = None,
    init: LearnedPlanner | None = None,
    init_path: Path | None = None,
    bags: Sequence[Path] = (),
) -> Trainer[MPOBatch]:
    """Open or resume a run.

    Args:
        config: What to train; fixed for the run.
        directory: Run directory.
        cadence: How often it publishes, evaluates and saves.
        device: Device of the learner, and of actors that share its process.
        actors: Where actors play; by default in this process, by turns with the learner.
        init: Network to start from, for example one that imitated; of the configuration's architecture.
        init_path: Where it comes from, for the record.
        bags: Directories of recorded bags whose transitions join the batches.

    Raises:
        ValueError: If the directory belongs to another run, or a bag is not what is expected.
    """
    origin = {"path": init_path.name, "digest": digest(init_path)} if init_path else None
    run = RunDirectory(directory, asdict(config) | {"init": origin})
    recorded = BagTransitions.read(bags) if bags else None
    learner = MPOLearner(config, device=device, init=init)
    if recorded is not None and config.bag_share == 1.0:
        source: Source[MPOBatch] = RecordedMoves(config, recorded)
    else:
        source = _played(config, learner.network, actors or ActorOptions(), device, recorded)
    record = {
        **provenance(),
        "method": "mpo",
        "training": asdict(config),
        "init": origin,
        "data": "bags" if isinstance(source, RecordedMoves) else _PLAYED + (" and bags" if bags else ""),
    }
    return Trainer(run, learner, source, Budget(), cadence, record=record)


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
def silence_verdicts(network: LearnedPlanner) -> None:
    """Let a network that will never be taught what is deadly call nothing so; a decision weighs these verdicts."""
    heads = network.heads
    verdicts = [heads.dead] if heads.push_dead is None else [heads.dead, heads.push_dead[-1]]
    for head in verdicts:
        assert isinstance(head, nn.Linear | nn.Conv2d) and head.bias is not None
        nn.init.zeros_(head.weight)
        nn.init.constant_(head.bias, -20.0)


@torch.no_grad()
def reset_stay_logit(network: LearnedPlanner) -> None:
    """Let a network that imitated, and never saw STAY, treat it as little less than the mean of the moves.

    Its logit was pushed to where exploration would never find out what STAY is worth.
    """
    head = network.heads.policy
    head.weight[Instruction.STAY] = head.weight[1:].mean(0)
    head.bias[Instruction.STAY] = head.bias[1:].mean() - 2.0
