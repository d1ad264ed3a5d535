"""MPO on the time-abstracted task (paper C.2): the training loop over the abstract environment.

The planner acts in thousands of levels at once; n-step returns off-policy from a replay train the Q head, discrete MPO
the policy head. A failed instruction's experience is dropped and ends the abstract episode early. Recorded bags of the
running stack may add their instruction-level transitions to the replay.

Shapes: B levels or batch, N = `grid.GRID_SIZE`, A = 5 instructions.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from mujoban_core.grid import CHANNELS, GRID_SIZE, Instruction
from mujoban_planner.abstract_env import AbstractEnvironment
from mujoban_planner.bag_transitions import BagTransitions
from mujoban_planner.boards import abstract_states
from mujoban_planner.planner import LearnedPlanner
from mujoban_planner.teacher import DISCOUNT
from mujoban_planner.validation import NetworkConfig, Shares, difficulty_shares, solve_rates
from mujoban_rl.limits import NaNGuard, StopSignal, TimeLimit
from mujoban_rl.losses.mpo import scalars
from mujoban_rl.losses.mpo_discrete import DiscreteMPO, DiscreteMPOConfig, expected_value
from mujoban_rl.losses.returns import windowed_returns
from mujoban_rl.replay import TimeMajorReplay
from mujoban_rl.run_directory import RunDirectory
from mujoban_rl.training_log import TrainingLog
from mujoban_rl.weights import digest, provenance, save_weights
from mujoban_sokoban.generator import TRAIN_SEEDS, generate_batch

_STATE = (GRID_SIZE, GRID_SIZE, len(CHANNELS))


@dataclass(frozen=True)
class MPOConfig(NetworkConfig):
    """What defines an MPO run."""

    mpo: DiscreteMPOConfig = field(default_factory=DiscreteMPOConfig)
    environments: int = 256
    """Levels played at once."""
    steps_per_update: int = 1
    """Steps of all environments per update."""
    replay_steps: int = 400
    """Steps of all environments kept."""
    warm_up_steps: int = 40
    """Steps before the first update."""
    batch_size: int = 256
    n_step: int = 5
    discount: float = DISCOUNT
    learning_rate: float = 1e-4
    dual_learning_rate: float = 1e-2
    target_period: int = 100
    """Updates between copies to the target network."""
    q_weight: float = 0.5
    """Weight of the critic's loss."""
    failure_rate: float = 0.0
    """Probability that an instruction fails, as with a real controller."""
    bag_share: float = 0.25
    """Share of a batch that comes from bags, where there are any."""
    mix: Shares = (0.1, 0.1, 0.15, 0.2, 0.45)
    """Share of each difficulty among the training levels."""
    seed: int = 0


class LevelStream:
    """Fresh training levels, one after the other."""

    def __init__(self, mix: dict[int, float], seed: int) -> None:
        """Draw difficulties by `mix`; `seed` chooses difficulties and levels."""
        self.next_seed = TRAIN_SEEDS.start + (500_000 + seed) * 10**9
        self._rng = np.random.default_rng([seed, 2])
        self._difficulties, shares = np.array(list(mix)), np.array(list(mix.values()))
        self._shares = shares / shares.sum()

    def draw(self, n: int) -> Tensor:
        """Return the abstract states of `n` fresh levels, [n, N, N, 4]."""
        states = np.empty((n, *_STATE), np.float32)
        difficulty = self._rng.choice(self._difficulties, n, p=self._shares)
        for d in np.unique(difficulty):
            rows = np.flatnonzero(difficulty == d)
            seeds = range(self.next_seed, self.next_seed + len(rows))
            assert seeds[0] in TRAIN_SEEDS and seeds[-1] in TRAIN_SEEDS
            self.next_seed += len(rows)
            states[rows] = abstract_states(generate_batch(int(d), seeds))
        return torch.from_numpy(states)


class MPOTrainer:
    """Trains a network by MPO; `run` does a bit of it, from the last checkpoint on."""

    def __init__(
        self,
        config: MPOConfig,
        directory: Path,
        *,
        device: str = "cpu",
        init: LearnedPlanner | None = None,
        init_path: Path | None = None,
        bags: Sequence[Path] = (),
    ) -> None:
        """Open or resume the run in `directory`.

        Args:
            config: What to train; fixed for the run.
            directory: Run directory.
            device: Device of network, environment and replay.
            init: Network to start from, for example one that imitated; of the configuration's architecture.
            init_path: Where it comes from, for the record.
            bags: Directories of recorded bags whose transitions join the replay.
        """
        self.config, self.device = config, torch.device(device)
        self.init = {"path": init_path.name, "digest": digest(init_path)} if init_path else None
        self.directory = RunDirectory(directory, asdict(config) | {"init": self.init})
        torch.manual_seed(config.seed)  # the initial weights
        self.network = (init or config.build()).to(self.device).train()
        if init is None:
            mute_verdicts(self.network)
        else:
            reset_stay_logit(self.network)
        self.target = copy.deepcopy(self.network).eval()
        self.mpo = DiscreteMPO(config.mpo).to(self.device)
        self.optimiser = torch.optim.Adam(
            [
                {"params": self.network.parameters(), "lr": config.learning_rate},
                {"params": self.mpo.parameters(), "lr": config.dual_learning_rate},
            ]
        )
        self.generator = torch.Generator().manual_seed(config.seed)
        self.levels = LevelStream(difficulty_shares(config.mix), config.seed)
        self.updates, self.env_steps, self.seconds = 0, 0, 0.0
        self._restore()
        failures = torch.Generator(self.device).manual_seed(config.seed)
        self.environment = AbstractEnvironment(
            config.environments, device=device, failure_rate=config.failure_rate, generator=failures
        )
        self.environment.reset_to(torch.arange(config.environments), self.levels.draw(config.environments))
        fields = {
            "state": (_STATE, torch.bool),
            "instruction": ((), torch.int64),
            "reward": ((), torch.float32),
            "terminated": ((), torch.bool),
            "dropped": ((), torch.bool),
        }
        self.replay = TimeMajorReplay(config.replay_steps, config.environments, fields, device)
        self.bags = BagTransitions.read(bags, self.device) if bags else None

    def run(self, *, seconds: float | None, updates: float, evaluate_every: float, save_every: float) -> None:
        """Train for `seconds`, up to `updates`, or until a signal; then save."""
        limit, guard = TimeLimit(seconds), NaNGuard()
        started, offset = time.monotonic(), self.seconds
        evaluated = saved = started
        total = None if updates == float("inf") else int(updates)
        with TrainingLog(self.directory, total=total, initial=self.updates, unit="update") as log, StopSignal() as stop:
            while self.updates < updates and not (limit.reached or stop.requested):
                for _ in range(self.config.steps_per_update):
                    self._act()
                if len(self.replay) < max(self.config.warm_up_steps, self.config.n_step + 1):
                    continue
                stats = self._update(guard)
                self.seconds = offset + time.monotonic() - started
                log.advance()
                if self.updates % 50 == 0:
                    log.scalars(self.updates, stats | {"env_steps": self.env_steps, "seconds": self.seconds})
                now = time.monotonic()
                if now - saved > save_every:
                    saved = now
                    self.save()
                if now - evaluated > evaluate_every:
                    evaluated = now
                    log.scalars(self.updates, self._evaluate(log))
            metrics = self._evaluate(log)
            log.scalars(self.updates, metrics)
            self.save(metrics)

    def save(self, metrics: dict[str, float] | None = None) -> None:
        """Write a checkpoint and the target network's weights with their record."""
        extra = {"env_steps": self.env_steps, "seconds": self.seconds, "next_seed": self.levels.next_seed}
        self.directory.save(
            self.updates,
            modules={"network": self.network, "target": self.target, "mpo": self.mpo},
            optimisers={"adam": self.optimiser},
            extra=extra,
            tensors={"generator": self.generator.get_state()},
        )
        record: dict[str, Any] = {
            **provenance(),
            "method": "mpo",
            "training": asdict(self.config),
            "init": self.init,
            "data": "abstract environment on generated levels, training seeds" + (" and bags" if self.bags else ""),
            "steps": self.updates,
            "env_steps": self.env_steps,
            "seconds": round(self.seconds),
            "metrics": metrics or {},
        }
        save_weights(self.directory.path / "planner.safetensors", self.target, self.target.config, record)

    def _restore(self) -> None:
        modules = {"network": self.network, "target": self.target, "mpo": self.mpo}
        snapshot = self.directory.load(modules=modules, optimisers={"adam": self.optimiser})
        if snapshot is None:
            return
        self.updates = snapshot.step
        self.env_steps, self.seconds = snapshot.extra["env_steps"], snapshot.extra["seconds"]
        self.levels.next_seed = snapshot.extra["next_seed"]
        self.generator.set_state(snapshot.tensors["generator"])

    @torch.no_grad()
    def _act(self) -> None:
        """Play one instruction, sampled from the policy, in every level."""
        state = self.environment.observe()
        with self._autocast():
            policy = self.network(state).policy
        chances = functional.softmax(policy, 1).cpu()
        instruction = torch.multinomial(chances, 1, generator=self.generator)[:, 0].to(self.device)
        step = self.environment.step(instruction)
        self.replay.add(
            {
                "state": state > 0.5,
                "instruction": instruction,
                "reward": step.reward,
                "terminated": step.solved,
                "dropped": step.truncated,
            }
        )
        self.env_steps += self.config.environments
        over = torch.nonzero(step.solved | step.truncated)[:, 0]
        if len(over):
            self.environment.reset_to(over, self.levels.draw(len(over)))

    def _update(self, guard: NaNGuard) -> dict[str, float]:
        config = self.config
        from_bags = int(config.batch_size * config.bag_share) if self.bags is not None else 0
        window = self.replay.sample(config.batch_size - from_bags, config.n_step, self.generator)
        returns = windowed_returns(
            window["reward"][:, :-1], window["terminated"][:, :-1], window["dropped"][:, :-1], config.discount
        )
        rows = torch.arange(len(returns.index), device=self.device)
        state, last = window["state"][:, 0].float(), window["state"][rows, returns.index].float()
        instruction, valid = window["instruction"][:, 0], returns.valid
        reward, bootstrap = returns.reward, returns.bootstrap
        if self.bags is not None and from_bags:
            extra = self.bags.sample(from_bags, self.generator)
            state, last = torch.cat([state, extra.state]), torch.cat([last, extra.next_state])
            instruction = torch.cat([instruction, extra.instruction])
            reward = torch.cat([reward, extra.reward])
            bootstrap = torch.cat([bootstrap, config.discount * (~extra.terminated).float()])
            valid = torch.cat([valid, torch.ones_like(extra.terminated)])
        with torch.no_grad(), self._autocast():
            before, after = self.target(state), self.target(last)
        target = reward + bootstrap * expected_value(after.q, after.policy)
        with self._autocast():
            output = self.network(state)
        policy_loss, stats = self.mpo(output.policy, before.policy, before.q)
        taken = output.q.gather(1, instruction[:, None])[:, 0]
        q_loss = (functional.smooth_l1_loss(taken, target, reduction="none") * valid).sum() / valid.sum().clamp(min=1)
        self.optimiser.zero_grad()
        (policy_loss + config.q_weight * q_loss).backward()
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), 40.0)
        if guard.accept(policy_loss.detach(), q_loss.detach(), norm):
            self.optimiser.step()
        self.updates += 1
        if self.updates % config.target_period == 0:
            self.target.load_state_dict(self.network.state_dict())
        finished = self.replay.storage["terminated"][: len(self.replay)].float().mean()
        progress = {"q_loss": q_loss.detach(), "mean_reward": reward.mean(), "solved_per_step": finished}
        return {k: float(v) for k, v in progress.items()} | scalars(stats._asdict())

    def _autocast(self) -> torch.autocast:
        return torch.autocast(self.device.type, torch.bfloat16)

    def _evaluate(self, log: TrainingLog) -> dict[str, float]:
        rates = solve_rates(self.target, reduced_precision=self.device.type == "cpu")
        log.message(f"{self.updates:8d} updates {self.env_steps:10d} steps  {rates}")
        return rates | {"env_steps": float(self.env_steps), "seconds": self.seconds}


@torch.no_grad()
def mute_verdicts(network: LearnedPlanner) -> None:
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
