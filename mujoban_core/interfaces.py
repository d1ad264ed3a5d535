"""The interfaces between the modules of sense-plan-act (paper Fig. 1b), in NumPy and with a batch axis.

To swap in a module of your own, subclass one of `Estimator`, `Termination`, `Planner` or `Controller` and
implement its abstract step. Batched evaluation and the ROS nodes run the same object: nodes with B = 1.

Shapes: B robots, N = `grid.GRID_SIZE`, K boxes, P proprioceptive values, U actuators.

State is explicit. A module never hides what it remembers: `initial_state` makes it, `step` takes it and
returns its successor, `renew_rows` restarts the rows of episodes that ended. A *memory* is a tuple of arrays
(NumPy or torch) whose first axis is the batch; a module without memory uses the empty tuple.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from mujoban_core.answers import answer_and_memory, check_probabilities, checked_instructions
from mujoban_core.grid import INSTRUCTION_LIMIT, Instruction
from mujoban_core.trees import map_leaves

StateT = TypeVar("StateT")

Memory = tuple[Any, ...]
"""A module's recurrent state: arrays or tensors with the batch on the first axis."""


class Observation(NamedTuple):
    """What the robot perceives in one tick (paper appendix B)."""

    frame: NDArray[np.uint8]
    """o_cam, first-person camera, RGB [B, 64, 64, 3]."""
    proprio: NDArray[np.float32]
    """o_pr, [B, P]; layout in `mujoban_core.bodies.ProprioSlices`."""
    pose: NDArray[np.float32]
    """o_pos = (x [m], y [m], psi [rad]) in the map frame, [B, 3]."""


class GroundTruth(NamedTuple):
    """What only the simulator knows; handed to oracles and to nobody else."""

    abstract_state: NDArray[np.float32]
    """s_abst, binary, [B, N, N, 4]."""
    pose: NDArray[np.float32]
    """(x [m], y [m], psi [rad]) in the map frame, [B, 3]."""
    velocity: NDArray[np.float32]
    """(vx [m/s], vy [m/s], yaw rate [rad/s]) in the map frame, [B, 3]."""
    box_position: NDArray[np.float32]
    """o_box, box centres in the map frame [m], [B, K, 2]; absent boxes lie far outside the grid."""
    completed: NDArray[np.bool_]
    """Whether the instruction in force is completed by the rule of paper C.4, [B]."""
    top_down: NDArray[np.uint8] | None = None
    """o_top, camera above the grid, RGB [B, 64, 64, 3]; None where nobody looks at it."""


class EstimatorInput(NamedTuple):
    """Inputs of the state estimator (paper C.1)."""

    frame: NDArray[np.uint8]
    pose: NDArray[np.float32]
    truth: GroundTruth | None = None


class TerminationInput(NamedTuple):
    """Inputs of the control-termination classifier (paper C.4)."""

    frame: NDArray[np.uint8]
    proprio: NDArray[np.float32]
    instruction: NDArray[np.int64]
    """A_{t-1}, [B]; `Instruction.STAY` on an episode's first tick."""
    terminated: NDArray[np.bool_]
    """beta_{t-1}, [B]."""
    truth: GroundTruth | None = None


class ControllerInput(NamedTuple):
    """Inputs of the controller (paper C.3)."""

    instruction: NDArray[np.int64]
    """A_t, [B]."""
    frame: NDArray[np.uint8]
    proprio: NDArray[np.float32]
    terminated: NDArray[np.bool_]
    """beta_t, [B]."""
    truth: GroundTruth | None = None


def take_rows(memory: Memory, rows: NDArray[np.int64]) -> Memory:
    """Return the given batch rows of every array of a memory."""
    return tuple(m[rows] for m in memory)


def put_rows(memory: Memory, rows: NDArray[np.int64], values: Memory) -> Memory:
    """Return a copy of a memory in which the given batch rows hold `values`."""
    copies = tuple(m.copy() if isinstance(m, np.ndarray) else m.clone() for m in memory)
    for copy, value in zip(copies, values, strict=True):
        copy[rows] = value
    return copies


def renew_rows(state: StateT, fresh: StateT, done: NDArray[np.bool_]) -> StateT:
    """Return a state in which the rows of ended episodes come from `fresh`, the others from `state`.

    Works on any nesting of tuples and NamedTuples of arrays or tensors, so on every module's state.
    """
    rows = np.flatnonzero(done)

    def renew(old: Any, new: Any) -> Any:
        renewed = old.copy() if isinstance(old, np.ndarray) else old.clone()
        renewed[rows] = new[rows]
        return renewed

    return map_leaves(renew, state, fresh)


def counter_uniform(seed: NDArray[np.int64], counter: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return uniform draws in [0, 1) that depend on (seed, counter) alone, of their common shape (splitmix64).

    Stateless draws keep a rollout independent of the batch that it runs in.
    """
    with np.errstate(over="ignore"):
        z = seed.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15) + counter.astype(np.uint64) + np.uint64(1)
        for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
            z = (z ^ (z >> np.uint64(shift))) * np.uint64(factor)
        z ^= z >> np.uint64(31)
    return (z >> np.uint64(11)).astype(np.float64) / float(1 << 53)


_MODULE_STREAM = 0x4D4F44


def module_seeds(run_seed: int, number: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the seeds of modules' random streams in episodes, [B]; they tell nothing of the levels.

    Args:
        run_seed: Of the run, at least 0.
        number: Numbers of the episodes within the run, from 1, [B].
    """
    return np.array(
        [np.random.SeedSequence([_MODULE_STREAM, run_seed, int(n)]).generate_state(1)[0] for n in number], np.int64
    )


class Module(ABC):
    """What the four modules have in common.

    The arrays that `step` is given are the module's own, to write into.
    """

    privileged: bool = False
    """Oracles set this and then receive `truth`; a learned module's `truth` is always None."""

    @abstractmethod
    def initial_memory(self, batch: int) -> Memory:
        """Return the memory of `batch` robots at the start of an episode."""

    def initial_state(self, seeds: NDArray[np.int64]) -> Memory:
        """Return the state at the start of episodes with the given seeds, [B]."""
        return self.initial_memory(len(seeds))


class Estimator(Module):
    """Sense: (o_cam, o_pos) -> estimate of s_abst (paper C.1)."""

    @abstractmethod
    def step(self, inputs: EstimatorInput, state: Memory) -> tuple[NDArray[np.float32], Memory]:
        """Return the probability of each layer in each cell, [B, N, N, 4], and the next state."""


class TerminationState(NamedTuple):
    """State of a `Termination`: its memory, the time an instruction has had, and its random stream."""

    memory: Memory
    elapsed: NDArray[np.int64]
    """Ticks since the instruction in force was issued, [B]."""
    tick: NDArray[np.int64]
    seed: NDArray[np.int64]


class TerminationOutput(NamedTuple):
    """Output of a `Termination`."""

    probability: NDArray[np.float32]
    """p_t(beta), [B]."""
    terminated: NDArray[np.bool_]
    """beta_t, [B]."""
    timed_out: NDArray[np.bool_]
    """Where beta_t was forced because the instruction had its `limit` ticks, [B]."""


def check_termination(*, limit: int, threshold: float) -> None:
    """Refuse settings with which a `Termination` would never or always say that an instruction is completed.

    Raises:
        ValueError: If one is out of its range.
    """
    if limit < 1:
        raise ValueError(f"limit is {limit}: expected a number of ticks from 1 on")
    if not 0.0 < threshold < 1.0:
        raise ValueError(f"threshold is {threshold}: expected a probability between 0 and 1")


class Termination(Module):
    """Decide whether the controller has completed the instruction (paper C.4).

    Subclasses give the probability; sampling or thresholding it, and forcing beta after `limit` ticks
    without one, is done here for learned classifiers and oracles alike.
    """

    def __init__(self, *, limit: int = INSTRUCTION_LIMIT, sample: bool = False, threshold: float = 0.5) -> None:
        """Sample beta ~ p as in the paper if `sample`, else beta = (p > threshold).

        Raises:
            ValueError: If a setting is out of its range.
        """
        super().__init__()
        check_termination(limit=limit, threshold=threshold)
        self.limit = limit
        self.sample = sample
        self.threshold = threshold

    @abstractmethod
    def probability(self, inputs: TerminationInput, memory: Memory) -> tuple[NDArray[np.float32], Memory]:
        """Return p(A_{t-1} is completed), [B], and the next memory."""

    def initial_state(self, seeds: NDArray[np.int64]) -> TerminationState:
        """Return the state at the start of episodes with the given seeds, [B]."""
        zeros = np.zeros(len(seeds), np.int64)
        return TerminationState(self.initial_memory(len(seeds)), zeros, zeros.copy(), np.asarray(seeds, np.int64))

    def step(self, inputs: TerminationInput, state: TerminationState) -> tuple[TerminationOutput, TerminationState]:
        """Return beta_t and the next state. On an episode's first tick nothing is in force and beta is false.

        Raises:
            ValueError: If what `probability` gives is not one for each robot.
        """
        said = self.probability(inputs, state.memory)
        probability, memory = answer_and_memory("probability of the termination", said)
        check_probabilities("termination", probability, state.tick.shape)
        first = state.tick == 0
        probability = np.where(first, np.float32(0.0), probability)
        bar = counter_uniform(state.seed, state.tick) if self.sample else self.threshold
        done = (probability > bar) & ~first
        timed_out = ~done & (state.elapsed >= self.limit)
        terminated = done | timed_out
        # The tick at which beta = 1 is also the first tick of the next instruction.
        elapsed = np.where(terminated, 0, state.elapsed) + 1
        output = TerminationOutput(probability, terminated, timed_out)
        return output, TerminationState(memory, elapsed, state.tick + 1, state.seed)


class PlannerState(NamedTuple):
    """State of a `Planner`: its memory and the instruction in force."""

    memory: Memory
    instruction: NDArray[np.int64]
    """A_{t-1}, [B]; -1 before an episode's first instruction."""
    sequence: NDArray[np.int64]
    """Number of instructions issued in this episode, [B]; numbers the instruction in force from 1."""


class Planner(Module):
    """Plan: estimate of s_abst -> instruction A, held until beta (paper C.2)."""

    @abstractmethod
    def decide(
        self, abstract_state: NDArray[np.float32], memory: Memory
    ) -> tuple[NDArray[np.int64], Memory]:
        """Return a new instruction for each of M robots, [M], from [M, N, N, 4], and their next memory."""

    thinks: bool = False
    """Whether it uses ticks in which no decision is due (`think`)."""

    def think(self, abstract_state: NDArray[np.float32], memory: Memory) -> Memory:
        """Return the memory of M robots after a tick in which their instruction goes on; estimates [M, N, N, 4]."""
        del abstract_state
        return memory

    def initial_state(self, seeds: NDArray[np.int64]) -> PlannerState:
        """Return the state at the start of episodes with the given seeds, [B]."""
        batch = len(seeds)
        return PlannerState(self.initial_memory(batch), np.full(batch, -1, np.int64), np.zeros(batch, np.int64))

    def step(
        self, abstract_state: NDArray[np.float32], terminated: NDArray[np.bool_], state: PlannerState
    ) -> tuple[NDArray[np.int64], PlannerState]:
        """Return A_t, [B]: a new decision where beta_t or where none is in force yet, else A_{t-1}.

        Raises:
            ValueError: If what was decided is not one instruction for each robot.
        """
        due = terminated | (state.instruction < 0)
        rows, others = np.flatnonzero(due), np.flatnonzero(~due)
        if self.thinks and others.size:
            memory = self.think(abstract_state[others], take_rows(state.memory, others))
            state = state._replace(memory=put_rows(state.memory, others, memory))
        if rows.size == 0:
            return state.instruction, state
        said = self.decide(abstract_state[rows], take_rows(state.memory, rows))
        decided, memory = answer_and_memory("decide of the planner", said)
        instruction, sequence = state.instruction.copy(), state.sequence.copy()
        instruction[rows] = checked_instructions(decided, rows.size)
        sequence[rows] += 1
        return instruction, PlannerState(put_rows(state.memory, rows, memory), instruction, sequence)


class Controller(Module):
    """Act: (A, o_cam, o_pr, beta) -> motor torques (paper C.3)."""

    @abstractmethod
    def step(self, inputs: ControllerInput, state: Memory) -> tuple[NDArray[np.float32], Memory]:
        """Return torques normalised to [-1, 1], [B, U], and the next state."""


NO_INSTRUCTION = int(Instruction.STAY)
"""What stands for A_{t-1} on an episode's first tick."""
