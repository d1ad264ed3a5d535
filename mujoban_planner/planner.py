"""The planner: abstract state -> instruction (paper C.2).

`LearnedPlanner` is what the architectures in `networks` have in common: input, read-out and the decision.

Shapes: B states, N = `grid.GRID_SIZE`, I = N - 2 (the border of a level is always wall, so the networks see the
interior alone), C channels, A = 5 instructions, D = 4 directions.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from mujoban_core.grid import CHANNELS, GRID_SIZE, Instruction
from mujoban_core.interfaces import Memory, Planner, put_rows, take_rows
from mujoban_planner.decision import (
    PushMeans,
    VisitCounts,
    VisitMemory,
    count_visits,
    doubtful,
    initial_means,
    initial_visits,
    push_penalty,
    recall,
    remember,
    running_mean,
    visit_penalty,
)
from mujoban_planner.heads import Advice, PlannerHeads, PlannerOutput, Weighed, log_alive, verdicts
from mujoban_planner.propagation import PLANES, propagate
from mujoban_rl.compiled import Compilable

CAUTION = 4.0
"""Weight of the verdicts in a decision by default: what solved most, of 1, 2, 4 and 8 (docs/research)."""
DOUBT = 0.02
"""Probability that a push is deadly from which on a planner looks from every side before it, by default."""


class LearnedPlanner(Compilable, Planner):
    """A planner network with its decision rule.

    The decision is greedy over log pi(A | s) + caution * log(1 - p(dead | s, A)), one forward pass, less a penalty for
    what was already tried (`decision.visit_penalty`, `decision.push_penalty`), so that it neither repeats for ever a
    move that does nothing nor runs in circles. What it says of the pushes is averaged over the views of the board that
    it took since the boxes stand as they do (`decision.PushMeans`): another side in each decision, and before a push
    that may be deadly (`decision.doubtful`) every side. The rule is deterministic; what it remembers is its explicit
    memory.
    """

    readout: PlannerHeads
    """Set by each architecture, after what comes before it in the network."""

    def __init__(self, *, propagation: bool, **config: Any) -> None:
        """Take the planes of `propagation.propagate` as further inputs if `propagation`.

        Args:
            propagation: Whether it does.
            config: The other keyword arguments that rebuild the module.
        """
        super().__init__()
        self._config = {**config, "propagation": propagation}
        self.propagation = propagation
        self.thinking = 1
        """Thinking time: repeats of the recurrent core or of the last blocks, or symmetric views, per decision."""
        self.caution = CAUTION
        """Weight of the verdicts on pushes and instructions in a decision; 1 is as trained."""
        self.doubt = DOUBT
        """Probability that a push is deadly from which on the planner looks from every side before it; 1 is never.

        Longer thinking doubts sooner: its odds are divided by `thinking`.
        """

    @property
    def device(self) -> torch.device:
        """Where the network is."""
        return next(self.parameters()).device

    @property
    def config(self) -> dict[str, Any]:
        """Keyword arguments that rebuild the module."""
        return dict(self._config)

    @abstractmethod
    def features(self, planes: Tensor) -> Tensor:
        """Return features [B, C, I, I] of the network's input planes, [B, `inputs`, I, I]."""

    @property
    def heads(self) -> PlannerHeads:
        """The read-out."""
        return self.readout

    def forward(self, abstract_state: Tensor, *, follow: bool = True) -> PlannerOutput:
        """Return the heads' outputs.

        Args:
            abstract_state: [B, N, N, 4] with values in [0, 1].
            follow: Whether the policy follows the push head without teaching it. Otherwise what teaches the policy
                teaches the pushes too, but never the verdicts, which are facts.
        """
        output, planes = self.read(abstract_state)
        wanted = (output.push.detach() if follow else output.push) + verdicts(output).detach()
        return output._replace(policy=output.policy + self.heads.guide(wanted, planes))

    def read(self, abstract_state: Tensor) -> tuple[PlannerOutput, Tensor]:
        """Return the outputs before the way to a push counts, and the input planes, [B, 4, I, I]."""
        features, planes, reachable = self.perceive(abstract_state)
        return self.heads(features, planes, reachable), planes

    def perceive(self, abstract_state: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return what the read-out reads: features [B, C, I, I], input planes [B, 4, I, I], where the robot can walk.

        The last is [B, I, I], or None without propagation.
        """
        planes = input_planes(abstract_state)
        spread = propagate(planes) if self.propagation else None
        inputs = planes if spread is None else torch.cat([planes, spread], 1)
        features = self.features(inputs.contiguous(memory_format=torch.channels_last))
        return features, planes, None if spread is None else spread[:, 0]

    @property
    def inputs(self) -> int:
        """Number of input planes."""
        return len(CHANNELS) + (PLANES if self.propagation else 0)

    def lay_out(self) -> None:
        """Store convolutions' weights channels-last, as they would rearrange them in every call."""
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                module.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]  # not in the stubs

    def initial_memory(self, batch: int) -> Memory:
        """Return an empty record of visits and means for `batch` episodes: `VisitMemory` and `PushMeans`."""
        return (*initial_visits(batch), *initial_means(batch))

    def decide(self, abstract_state: NDArray[np.float32], memory: Memory) -> tuple[NDArray[np.int64], Memory]:
        """Return an instruction for each state, [M] from [M, N, N, 4], and the next memory.

        Raises:
            ValueError: If the states have another shape or hold values that are not finite.
        """
        check_abstract_state(abstract_state)
        visits, means = split_memory(memory)
        decision, means = self.choose(
            abstract_state, count_visits(abstract_state, visits), recall(abstract_state, means)
        )
        return decision, (*remember(abstract_state, decision, visits), *means)

    def choose(
        self, abstract_state: NDArray[np.float32], counts: VisitCounts, means: PushMeans
    ) -> tuple[NDArray[np.int64], PushMeans]:
        """Return the instruction of the highest score, [M], and means; see `scores`.

        While that is a push that may be deadly, the board is looked at from another side, until all were seen.
        """
        scores, means = self.scores(abstract_state, counts, means)
        decision = np.argmax(scores, axis=1)
        for _ in range(self.perspectives - 1):
            again = means.views < self.perspectives
            rows = np.flatnonzero(again & doubtful(abstract_state, decision, means, self._least_doubt()))
            if not rows.size:
                break
            part = VisitCounts(*take_rows(counts, rows)), PushMeans(*take_rows(means, rows))
            scores, seen = self.scores(abstract_state[rows], *part)
            decision[rows], means = np.argmax(scores, axis=1), PushMeans(*put_rows(means, rows, seen))
        return decision, means

    def _least_doubt(self) -> float:
        """Return the probability of `doubt`, its odds divided by the thinking time."""
        return self.doubt / (self.doubt + self.thinking * (1.0 - self.doubt))

    @torch.inference_mode()
    def scores(
        self, abstract_state: NDArray[np.float32], counts: VisitCounts, means: PushMeans
    ) -> tuple[NDArray[np.float64], PushMeans]:
        """Return log pi(A | s) + caution * log(1 - p(dead | s, A)), less what was tried before, [M, A], and means.

        Args:
            abstract_state: [M, N, N, 4].
            counts: What was tried before.
            means: Of earlier decisions with the boxes where they are.
        """
        penalty = push_penalty(counts)[..., 1:-1, 1:-1]
        inputs = (abstract_state, means.views, means.push, means.push_alive, penalty, np.array(self.caution))
        inputs = [np.ascontiguousarray(x, np.int64 if x.dtype.kind == "i" else np.float32) for x in inputs]
        if self.compiled is not None and len(abstract_state) == self.thinking == 1:
            score, push, push_alive, _ = self.compiled(inputs)
        else:
            weighed = self.weigh(*(torch.from_numpy(x).to(self.device) for x in inputs))
            score, push, push_alive, _ = (x.cpu().numpy() for x in weighed)
        means = PushMeans(means.boxes, means.views + self.views, push, push_alive)
        return score.astype(np.float64) - visit_penalty(counts), means

    def weigh(
        self, states: Tensor, seen: Tensor, push: Tensor, push_alive: Tensor, penalty: Tensor, caution: Tensor
    ) -> Weighed:
        """Return the scores of the instructions, but for what was tried, and means: one forward pass.

        It is what `export` exports, hence tensors alone.

        Args:
            states: [B, N, N, 4].
            seen: Views of each state's boxes that were taken before, int64 [B].
            push: Log-probability of each next push, the mean over these views, [B, D, I, I].
            push_alive: log(1 - p(dead)) of each push, likewise.
            penalty: What is taken off the log-probability of each push that is wanted, [B, D, I, I].
            caution: Weight of the verdicts, [].
        """
        advice = self.advise(states, seen)
        push = running_mean(self.views, seen, push, advice.push)
        push_alive = running_mean(self.views, seen, push_alive, advice.push_alive)
        wanted = push + caution * push_alive - penalty
        policy = advice.policy + self.heads.guide(wanted, input_planes(states))
        score = functional.log_softmax(policy, 1) + caution * advice.alive
        return Weighed(score, push, push_alive, advice.alive[:, Instruction.STAY])

    @property
    def rereads(self) -> bool:
        """Whether longer thinking is to read a board again, as a search then does too, and not to see more views."""
        return self.thinking > 1 and self.views == 1

    @property
    def views(self) -> int:
        """Symmetric views of the board that go into one decision."""
        return 1

    @property
    def perspectives(self) -> int:
        """Different views of the board that successive decisions take; one more tells nothing new."""
        return 1

    def advise(self, states: Tensor, seen: Tensor) -> Advice:
        """Return what a decision weighs, with the thinking time that is set.

        Args:
            states: [B, N, N, 4].
            seen: Views of each state's boxes that were taken before, int64 [B].
        """
        del seen  # a network that takes the board as it is
        output, _ = self.read(states)
        return Advice(output.policy, log_alive(output.dead), output.push, verdicts(output, wary=True))


def split_memory(memory: Memory) -> tuple[VisitMemory, PushMeans]:
    """Return the two parts of a learned planner's memory."""
    visits = len(VisitMemory._fields)
    return VisitMemory(*memory[:visits]), PushMeans(*memory[visits:])


def check_abstract_state(abstract_state: NDArray[np.float32]) -> None:
    """Raise ValueError unless an abstract state is [M, N, N, 4] and finite."""
    expected = (GRID_SIZE, GRID_SIZE, len(CHANNELS))
    if abstract_state.ndim != 4 or abstract_state.shape[1:] != expected:
        raise ValueError(f"abstract state has shape {abstract_state.shape}, expected (M, *{expected})")
    if not np.isfinite(abstract_state).all():
        raise ValueError("abstract state holds values that are not finite, expected probabilities in [0, 1]")


def input_planes(abstract_state: Tensor) -> Tensor:
    """Return the interior as planes (floor, target, agent, box), [B, 4, I, I] from [B, N, N, 4].

    Floor rather than wall, so that the zero padding of a convolution means wall.
    """
    planes = abstract_state[:, 1:-1, 1:-1].permute(0, 3, 1, 2)
    return torch.cat([1.0 - planes[:, :1], planes[:, 1:]], 1)
