"""Batched rollout of a policy in one process: the twin of the ROS graph, for evaluation and data collection.

Shapes: B rows of the world, M <= B rows in which an episode is still running.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from bringup.failure import EpisodeLog
from bringup.results import EpisodeResult
from mujoban_core.answers import check_torques
from mujoban_core.bodies import FIRST_PERSON_CAMERA
from mujoban_core.camera import FRAME_SIZE, TOP_DOWN_CAMERA
from mujoban_core.interfaces import GroundTruth, Observation, module_seeds, renew_rows
from mujoban_core.sense_plan_act import Decision
from mujoban_core.trees import map_leaves
from mujoban_sim.world import World
from mujoban_sokoban.episodes import EpisodeSpec, LazyEpisodes

if TYPE_CHECKING:
    from mujoban_sim.rendering import CameraName

Tree = TypeVar("Tree")


class Policy(Protocol):
    """What plays: `mujoban_core.sense_plan_act.SensePlanAct`, or `mujoban_core.agent.AgentPolicy`."""

    @property
    def cameras(self) -> tuple[str, ...]:
        """The cameras whose frames it looks at."""
        ...

    def initial_state(self, seeds: NDArray[np.int64]) -> Any:
        """Return the state at the start of episodes with the given seeds, [B]."""
        ...

    def robots_looking(self, state: Any) -> NDArray[np.bool_] | None:
        """Return which robots look at their frames in the coming tick, [B]; None: all do."""
        ...

    def step(self, obs: Observation, truth: GroundTruth, state: Any) -> tuple[Decision, Any]:
        """Return the decision of a tick and the next state."""
        ...


class Ending(NamedTuple):
    """What E rows of the world hold behind the last tick of their episodes."""

    observation: Observation
    truth: GroundTruth


class Tick(NamedTuple):
    """One tick of the M rows in which an episode runs."""

    rows: NDArray[np.int64]
    """Rows of the world, [M]."""
    episode: NDArray[np.int64]
    """Index of the episode that runs in each of these rows, [M]."""
    step: NDArray[np.int64]
    """Number of this tick within its episode, from 0, [M]."""
    observation: Observation
    truth: GroundTruth
    decision: Decision
    reward: NDArray[np.float32]
    """Reward for the torque of this tick, [M]."""
    episode_return: NDArray[np.float32]
    """Sum of the rewards, that of this tick included, [M]."""
    solved: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    """Whether the episode's time ran out with this tick, [M]."""
    ending: Ending | None = None
    """What those rows hold now whose episodes ended with this tick, in their order; None if none did."""


def select(tree: Tree, rows: NDArray[np.int64]) -> Tree:
    """Return the given batch rows of every array in any nesting of tuples and NamedTuples; None stays."""
    return map_leaves(lambda leaf: None if leaf is None else leaf[rows], tree)


def ticks(
    policy: Policy,
    world: World,
    episodes: Sequence[EpisodeSpec],
    *,
    camera: bool | None = None,
    run_seed: int = 0,
) -> Iterator[Tick]:
    """Play every episode once and yield each tick; a row takes the next episode as soon as its own has ended.

    The modules' random streams come from `run_seed` and the number of the episode, not from its level.

    Rows without a further episode leave the policy's batch, so that the last, long episodes cost no more
    than they must. Frames are rendered if and when the policy looks at them, and black otherwise, unless `camera` says
    that all are, or none.
    """
    if not episodes:
        return
    waiting = iter(range(world.batch, len(episodes)))
    # A world without an episode in a row cannot step: spare rows stand idle in the first one.
    world.reset(np.arange(world.batch), [episodes[i if i < len(episodes) else 0] for i in range(world.batch)])
    rows = np.arange(min(world.batch, len(episodes)))
    episode = rows.copy()
    step = np.zeros(len(rows), np.int64)
    seeds = module_seeds(run_seed, _numbers(episodes, episode))
    state = policy.initial_state(seeds)
    asked, camera = camera is None, FIRST_PERSON_CAMERA in policy.cameras if camera is None else camera
    above = TOP_DOWN_CAMERA in policy.cameras
    torque = np.zeros((world.batch, world.body.action_size), np.float32)
    instruction = np.zeros(world.batch, np.int64)
    issued = np.zeros(world.batch, np.bool_)
    while True:
        looking = policy.robots_looking(state) if asked else None
        observation = observe(world, rows, camera=camera, looking=looking)
        truth = tell(world, rows, above=above, looking=looking)
        decision, state = policy.step(observation, truth, state)
        check_torques(decision.torque, (len(rows), world.body.action_size))
        torque[:], issued[:] = 0.0, False
        torque[rows], instruction[rows], issued[rows] = decision.torque, decision.instruction, decision.issued
        world.instruct(instruction, issued)
        world.step(torque)
        solved, truncated = world.solved[rows], world.truncated[rows]
        ended = solved | truncated
        yield Tick(
            rows, episode, step, observation, truth, decision,
            world.reward[rows], world.episode_return[rows], solved, truncated,
            _ending(world, rows[ended], camera=camera, above=above) if ended.any() else None,
        )
        step = step + 1
        if not ended.any():
            continue
        episode, finished = episode.copy(), np.zeros(len(rows), np.bool_)
        for m in np.flatnonzero(ended):
            following = next(waiting, None)
            finished[m] = following is None
            episode[m] = -1 if following is None else following
        renewed = ended & ~finished
        if renewed.any():
            world.reset(rows[renewed], [episodes[i] for i in episode[renewed].tolist()])
            seeds[renewed] = module_seeds(run_seed, _numbers(episodes, episode[renewed]))
            state = renew_rows(state, policy.initial_state(seeds), renewed)
            step[renewed] = 0
        kept = np.flatnonzero(~finished)
        if kept.size == 0:
            return
        if kept.size < len(rows):
            rows, episode, step, seeds, state = select((rows, episode, step, seeds, state), kept)


def _numbers(episodes: Sequence[EpisodeSpec], index: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the numbers, from 1 on, of episodes within the run that they may be a share of, [B]."""
    if isinstance(episodes, LazyEpisodes):
        return np.array([episodes.number(i) for i in index.tolist()], np.int64)
    return index + 1


def _ending(world: World, rows: NDArray[np.int64], *, camera: bool, above: bool) -> Ending:
    return Ending(observe(world, rows, camera=camera), tell(world, rows, above=above))


def rollout(
    policy: Policy,
    world: World,
    episodes: Sequence[EpisodeSpec],
    *,
    on_result: Callable[[int, EpisodeResult], None] | None = None,
) -> list[EpisodeResult]:
    """Play every episode once and return the outcomes in the order of `episodes`.

    Args:
        policy: The four modules, or an agent.
        world: Its rows are all reset; their number is the batch.
        episodes: Levels and seeds.
        on_result: Called with the index of an episode and its outcome as soon as it has ended.
    """
    judge = Judge(episodes)
    results: dict[int, EpisodeResult] = {}
    for tick in ticks(policy, world, episodes):
        for index, result in judge.observe(tick):
            results[index] = result
            if on_result is not None:
                on_result(index, result)
    return [results[i] for i in range(len(episodes))]


class Judge:
    """Turns ticks into outcomes of episodes."""

    def __init__(self, episodes: Sequence[EpisodeSpec]) -> None:
        """Judge the ticks of the given episodes."""
        self._episodes = episodes
        self._logs: dict[int, EpisodeLog] = {}

    def observe(self, tick: Tick) -> list[tuple[int, EpisodeResult]]:
        """Note one tick; return the index and outcome of every episode that ended with it."""
        said = tick.decision
        for m in np.flatnonzero(said.issued):
            index = int(tick.episode[m])
            log = self._logs.setdefault(index, EpisodeLog(self._episodes[index].seed))
            log.decided(
                tick.truth.abstract_state[m], said.abstract_state[m], said.instruction[m], said.termination.timed_out[m]
            )
        results = []
        for m, row in enumerate(np.flatnonzero(tick.solved | tick.truncated)):
            assert tick.ending is not None
            index = int(tick.episode[row])
            log = self._logs.pop(index, None) or EpisodeLog(self._episodes[index].seed)
            results.append(
                (index, log.result(
                    solved=tick.solved[row], steps=tick.step[row] + 1, episode_return=tick.episode_return[row],
                    last=tick.ending.truth.abstract_state[m],
                ))
            )  # fmt: skip
        return results


def tell(
    world: World, rows: NDArray[np.int64], *, above: bool, looking: NDArray[np.bool_] | None = None
) -> GroundTruth:
    """Return what only the simulator knows of the given rows, with the view from above where that is wanted.

    That of robots that are not `looking`, [M], is black.
    """
    truth = world.truth(rows)
    return truth._replace(top_down=_view(world, TOP_DOWN_CAMERA, rows, looking)) if above else truth


def observe(
    world: World, rows: NDArray[np.int64], *, camera: bool = True, looking: NDArray[np.bool_] | None = None
) -> Observation:
    """Return what the robots in the given rows perceive.

    Without `camera` the frames are empty, [M, 0, 0, 3]; of those that are not `looking`, [M], they are black.
    """
    empty = np.zeros((len(rows), 0, 0, 3), np.uint8)
    frame = _view(world, FIRST_PERSON_CAMERA, rows, looking) if camera else empty
    return Observation(frame, world.proprio[rows], world.pose[rows])


def _view(
    world: World, camera: CameraName, rows: NDArray[np.int64], looking: NDArray[np.bool_] | None
) -> NDArray[np.uint8]:
    if looking is None:
        return world.render(camera, rows=rows)
    frame = np.zeros((len(rows), FRAME_SIZE, FRAME_SIZE, 3), np.uint8)
    if looking.any():
        frame[looking] = world.render(camera, rows=rows[looking])
    return frame
