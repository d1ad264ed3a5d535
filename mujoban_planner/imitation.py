"""Imitation of the solver: the configuration, the loss, and who learns.

Shapes: B batch, N = `grid.GRID_SIZE`, I = N - 2, A = 5 instructions.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional

from mujoban_core.ranges import check_counts, check_not_negative, check_positive, check_shares
from mujoban_msgs_py.bags.training import bags_digest, check_batch_share
from mujoban_planner.bag_lessons import BagLessons, Lessons, LessonsAndBags
from mujoban_planner.growth import beginning, open_run
from mujoban_planner.lesson_source import LessonActor, LessonConfig, LessonSource
from mujoban_planner.planner import LearnedPlanner
from mujoban_planner.product import PlannerLearner
from mujoban_planner.samples import Batch
from mujoban_planner.teacher import HOPELESS
from mujoban_planner.uncertainty import UncertaintyConfig
from mujoban_planner.validation import NetworkConfig
from mujoban_rl.actors import ActorOptions
from mujoban_rl.engine import Budget, Cadence, Source, State, Trainer
from mujoban_rl.limits import NaNGuard
from mujoban_rl.optimise import ProgressSchedule, guarded_step, moving_average, warm_up_cosine
from mujoban_rl.precision import autocast
from mujoban_rl.weights import lineage, origin, provenance, usable_device

_CLIP = 1.0
"""Largest norm of the gradient."""
_CHOSEN = 0.1
"""Weight of verdicts on pushes whose choice hangs on what they are."""
_LONGEST = 70
"""Moves that one generated level in a hundred takes, or fewer."""


@dataclass(frozen=True)
class LearnerConfig(NetworkConfig):
    """What defines a network and how it learns from labelled states."""

    learning_rate: float = 1e-3
    """Learning rate."""
    weight_decay: float = 1e-3
    """Decay of the weights, of AdamW."""
    warm_up: float = 0.02
    """Share of the schedule in which the learning rate rises."""
    plan_weight: float = 3.0
    """Weight of the plan map in the loss."""
    value_weight: float = 0.02
    """Weight of the Q-values in the loss."""
    push_weight: float = 1.0
    """Weight of the next push in the loss."""
    dead_weight: float = 1.0
    """Weight of the dead-state head in the loss."""
    ema: float = 0.999
    """Decay of the averaged weights, which are what is played and shipped."""
    thoughts: tuple[int, ...] = (1,)
    """Thinking times, one for each batch in turns."""
    init: str | None = None
    """Weights to start from: of the same or fewer channels and blocks."""
    init_share: float = 0.0
    """Their share in what is played and shipped, the rest being the average's: what lies between a network and what a
    further training makes of it often solves more than both (Wortsman et al. 2022, WiSE-FT)."""
    seed: int = 0
    """Seed of networks and of all that is drawn."""

    def __post_init__(self) -> None:
        """Reject networks of nothing, and what is no rate, no share and no thinking time."""
        NetworkConfig.__post_init__(self)
        check_counts(self, "seed", least=0)
        check_positive(self, "learning_rate")
        check_not_negative(self, "weight_decay", "plan_weight", "value_weight", "push_weight", "dead_weight")
        check_shares(self, "warm_up", "ema", "init_share")
        if not self.thoughts or min(self.thoughts) < 1:
            raise ValueError(f"--thoughts {' '.join(map(str, self.thoughts))}: expected numbers from 1")


@dataclass(frozen=True)
class ImitationConfig(LessonConfig, LearnerConfig):
    """What defines an imitation run."""

    horizon_seconds: float = 1e9
    """Training time at which the cosine schedule ends, whichever of this and the next two comes first."""
    horizon_samples: float = 4e6
    """Samples at which the cosine schedule ends."""
    cpu_seconds: float = 1e9
    """CPU seconds of all processes at which the cosine schedule ends."""
    bag_share: float = 0.25
    """Share of a batch that comes from bags, where there are any; 1: all, and no lesson is made."""
    bag_estimates: float = 0.8
    """Share of these decisions that are shown as they were estimated, the others as they were."""

    def __post_init__(self) -> None:
        """Reject what is no share, a budget of nothing, and levels that are hardly found."""
        LessonConfig.__post_init__(self)
        LearnerConfig.__post_init__(self)
        check_positive(self, "cpu_seconds")
        check_batch_share(self.bag_share)
        if self.long_moves > _LONGEST:
            raise ValueError(f"--long-moves {self.long_moves}: expected at most {_LONGEST}, as few levels take more")
        _ = self.budget

    @property
    def budget(self) -> Budget:
        """When the run is complete."""
        return Budget(self.horizon_samples, seconds=self.horizon_seconds, cpu_seconds=self.cpu_seconds)


def check_init_share(config: LearnerConfig) -> None:
    """Raise ValueError if weights are to have a share that there are none of."""
    if config.init_share and config.init is None:
        raise ValueError(f"init_share is {config.init_share}: expected 0, or an --init whose share it is")


def imitation_loss(planner: nn.Module, batch: Batch, config: LearnerConfig) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the loss and its parts, scalars.

    Policy: -log of the probability of all right instructions together. Q: regression of the demonstration's return
    on right instructions and of the return of doing nothing on deadly ones. Dead: cross-entropy where known. Plan map:
    cross-entropy per cell where there is a demonstration.
    """
    output = planner(batch.state)
    shown = batch.right.any(1)
    n = shown.sum().clamp(min=1)
    log_policy = functional.log_softmax(output.policy, 1)
    right = log_policy.masked_fill(~batch.right, -1e9).logsumexp(1)
    policy = -(right * shown).sum() / n
    plan = functional.cross_entropy(output.plan, batch.plan, reduction="none").mean((1, 2))
    plan = (plan * shown).sum() / n
    known = batch.dead_known.float()
    dead = functional.binary_cross_entropy_with_logits(output.dead, batch.dead.float(), weight=known, reduction="sum")
    dead = dead / known.sum().clamp(min=1)
    if output.push_dead is not None:
        dead = dead + _verdict_loss(output.push_dead, batch)
    q_known = (batch.right | batch.dead).float()
    q_target = torch.where(batch.dead, HOPELESS, batch.value[:, None])
    q = functional.smooth_l1_loss(output.q, q_target, reduction="none")
    q = (q * q_known).sum() / q_known.sum().clamp(min=1)
    push = output.push.flatten(1).gather(1, batch.next_push[:, None])[:, 0]
    push = -(push * shown).sum() / n
    best = (output.push.flatten(1).argmax(1) == batch.next_push) & shown
    loss = policy + config.push_weight * push + config.plan_weight * plan
    loss = loss + config.dead_weight * dead + config.value_weight * q
    correct = batch.right.gather(1, log_policy.argmax(1, keepdim=True))[:, 0]
    accuracy = (correct & shown).sum() / n
    caught = ((output.dead > 0) & batch.dead).sum() / batch.dead.sum().clamp(min=1)
    parts = {"policy": policy, "accuracy": accuracy, "push": push, "push_accuracy": best.sum() / n}
    parts |= {"plan": plan, "dead": dead, "dead_recall": caught, "q": q}
    return loss, {k: v.detach() for k, v in parts.items()}


def _verdict_loss(logit: Tensor, batch: Batch) -> Tensor:
    """Return the cross-entropy of verdicts on pushes, [B, D, I, I], where known.

    Those whose choice hangs on what they are say too seldom that a push is deadly: they count little, while there are
    others.
    """
    errors = functional.binary_cross_entropy_with_logits(logit, batch.push_dead.float(), reduction="none")
    means, counts = [], []
    for rows in (~batch.chosen, batch.chosen):
        known = batch.push_known & rows[:, None, None, None]
        counts.append(known.sum())
        means.append((errors * known).sum() / counts[-1].clamp(min=1))
    return means[0] + torch.where(counts[0] > 0, _CHOSEN, 1.0) * means[1]


class ImitationLearner(PlannerLearner[Batch]):
    """Trains a network on lessons; the moving average of its weights is what is played and shipped.

    With `LearnerConfig.init_share` these lie between the average and what it began with.

    Which average solves the most levels that are seen whole does not tell which does best on estimates: where lessons
    show these, the last one is exported.
    """

    def __init__(
        self, config: LearnerConfig, uncertainty: UncertaintyConfig, device: torch.device | str = "cpu"
    ) -> None:
        """Make the network.

        Args:
            config: How it learns.
            uncertainty: How lessons show states.
            device: Device of the network.
        """
        super().__init__()
        self.chooses = not uncertainty.shows_estimates
        self.config, self.device = config, usable_device(device)
        torch.manual_seed(config.seed)  # the initial weights
        self.network = beginning(config, config.init).to(self.device)
        self._initial = copy.deepcopy(self.network) if config.init_share else self.network
        self._average = moving_average(self.network, config.ema, warm_up=True)
        self._product = copy.deepcopy(self._average.module) if config.init_share else self._average.module
        self.optimiser = torch.optim.AdamW(
            self.network.parameters(), config.learning_rate, (0.9, 0.98), weight_decay=config.weight_decay, fused=True
        )
        self._schedule = ProgressSchedule(self.optimiser, warm_up_cosine(config.warm_up))
        self._updates = 0

    @property
    def product(self) -> LearnedPlanner:
        """The moving average, or what lies between it and what it began with."""
        if share := self.config.init_share:
            networks = (self._product, self._average.module, self._initial)
            with torch.no_grad():
                for between, average, initial in zip(*(n.parameters() for n in networks), strict=True):
                    between.copy_(torch.lerp(average, initial, share))
        return self._product

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        """The network and its average."""
        return {"network": self.network, "average": self._average}

    @property
    def optimisers(self) -> Mapping[str, torch.optim.Optimizer]:
        """One."""
        return {"adamw": self.optimiser}

    def own_state(self) -> State:
        """Return the number of updates."""
        return State({"updates": self._updates})

    def restore_own(self, state: State) -> None:
        """Take over what `own_state` returned."""
        self._updates = state.values["updates"]

    def update(self, batch: Batch, progress: float, guard: NaNGuard) -> dict[str, float]:
        """Take one gradient step; return the parts of the loss."""
        self._schedule.follow(progress)
        thoughts = self.config.thoughts
        self.network.thinking = thoughts[self._updates % len(thoughts)]
        self._updates += 1
        with autocast(self.device):
            loss, parts = imitation_loss(self.network, batch.to(self.device), self.config)
        if guarded_step(loss, [self.optimiser], guard, clip=_CLIP) is not None:
            self._average.update_parameters(self.network)
        rate = self.optimiser.param_groups[0]["lr"]
        return {f"train/{name}": float(value) for name, value in parts.items()} | {"learning_rate": rate}

    def weights(self) -> Mapping[str, Tensor]:
        """Return the product, whose play is corrected."""
        return self.product.state_dict()


def imitation(
    config: ImitationConfig, directory: Path, cadence: Cadence | None = None, *, device: str = "cpu",
    actors: ActorOptions | None = None, bags: Sequence[Path] = (),
) -> Trainer[Batch]:  # fmt: skip
    """Open or resume a run.

    Args:
        config: What to train; fixed for the run.
        directory: Run directory.
        cadence: How often it evaluates and saves.
        device: Device of the networks, of the learner and of those whose play is corrected.
        actors: Where lessons are made; in between by default.
        bags: Recorded bags, or folders of bags, whose decisions are labelled and join the batches.

    Raises:
        RunError: If the directory belongs to another run.
        BagError: If a bag is not what is expected.
        WeightsError: If the weights to start from are missing or damaged, or do not fit into the network.
        ValueError: If weights are to have a share that there are none of.
    """
    check_init_share(config)
    run = open_run(directory, config)
    learner = ImitationLearner(config, config, device)
    source = _source(config, actors or ActorOptions(), bags, device)
    record = {
        **provenance(),
        "method": "imitation",
        "training": asdict(config),
        "data": lineage(_data(config, bags), config.init),
        "init": origin(config.init),
        "bags": [bag.name for bag in bags],
        "bags_digest": bags_digest(bags),
    }
    return Trainer(run, learner, source, config.budget, cadence, record=record)


def _source(config: ImitationConfig, actors: ActorOptions, bags: Sequence[Path], device: str) -> Source[Batch]:
    """Return lessons, decisions from bags, or both."""
    if not bags:
        return _lessons(config, actors, device)
    recorded = round(config.bag_share * config.batch_size)
    found = BagLessons(Lessons.read(bags, config.seed), max(recorded, 1), config.bag_estimates, config.seed)
    if recorded >= config.batch_size:
        return found
    fewer = replace(config, batch_size=config.batch_size - recorded)
    return LessonsAndBags(_lessons(fewer, actors, device), found)


def _lessons(config: ImitationConfig, actors: ActorOptions, device: str) -> LessonSource:
    return LessonSource(config, actors.pool(partial(LessonActor, config, config.network, device=device)))


def _data(config: ImitationConfig, bags: Sequence[Path]) -> str:
    lessons = "solver demonstrations and corrections of own play on generated levels, training seeds"
    recorded = "decisions in bags, labelled by the solver"
    if not bags:
        return lessons
    return recorded if config.bag_share == 1.0 else f"{lessons}; {recorded}"
