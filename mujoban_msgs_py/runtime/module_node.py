"""The base of the four module nodes: a `TickNode` around a module of `mujoban_core.interfaces`."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar, Unpack, cast

import numpy as np
from mujoban_msgs.msg import Episode
from numpy.typing import NDArray
from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from std_msgs.msg import Header

from mujoban_core.answers import answering
from mujoban_core.bodies import BALL, BODIES, Body, get_body
from mujoban_core.interfaces import GroundTruth, Module, module_seeds
from mujoban_core.look_around import LOOKING_ROLES, Scout, look_around
from mujoban_core.plugins import (
    LEARNED,
    PRIVILEGED,
    check_body,
    check_told,
    chosen_weights,
    load_module,
    trained_body,
)
from mujoban_core.threads import set_threads
from mujoban_msgs_py import conversions, topics
from mujoban_msgs_py.adapted import Adapted, message_of
from mujoban_msgs_py.runtime.descriptors import NodeOptions, declare, declare_run, described
from mujoban_msgs_py.runtime.diagnostics import MODULE, WEIGHTS, Condition
from mujoban_msgs_py.runtime.kept import KeptArrays, leaves, with_leaves
from mujoban_msgs_py.runtime.tick_node import Output, TickNode
from mujoban_msgs_py.topics import Message, Topic

MOST_TICKS = 1_000_000
"""Upper end of ranges of ticks, which have none of their own."""
OWN_LOOK = -1
"""Stands for the ticks of a look that are the body's own."""
AS_IT_ASKS = -1
"""Says that a module is told the ground truth if it asks for it."""
_PLACE, _ANSWER, _LEAF = "place", "answer", "state."
"""Keys of what a node keeps: the number of the episode and the stamp of the tick; its answer; arrays of the state."""
TRUTH_INPUTS = (
    topics.TRUE_ABSTRACT_STATE, topics.TRUE_POSE, topics.TRUE_TWIST, topics.TRUE_BOXES, topics.TRUE_TERMINATION
)  # fmt: skip
"""What a privileged module receives besides."""


ModuleT = TypeVar("ModuleT", bound=Module)


class ModuleNode(TickNode, Generic[ModuleT]):
    """A thin shell around one module: messages in, one step of the module with B = 1, message out.

    Parameters:
        module: "learned", "oracle" or `package.module:Class`; fixed when the node starts.
        weights: Weights file of the learned module; empty means those that ship, for the body if there are. Setting
            it while the node runs loads them, and the module's memory restarts with the next tick. Weights that cannot
            be loaded are refused, and the old ones stay; so are those that need the ground truth where the node began
            without.
        body: The robot's body, of which the weights have to be; empty means any. Fixed when the node starts.
        device: Device of the learned module; setting it loads the weights again.
        told: Whether the module is told the ground truth, 1 or 0, as reports of the run say: one that asks otherwise is
            refused. -1: as it asks. Fixed when the node starts.
        threads: Threads of PyTorch in this process; at batch 1 further ones gain little on an idle machine, and on a
            busy one they wait for each other. Fixed when the node starts.
        run: Identifier of the run that the module answers; -1 for any. Fixed when the node starts.
        run_seed: Seed of the module's random streams, one for each number of an episode; fixed when the node starts.
        look_around: Of planner and controller alone: ticks of a look, which is a turn on the spot; 0 for none, -1 for
            those of the body. Fixed when the node starts.
        resume_file: Where the node keeps what it remembers after every tick, so that it goes on from there after it was
            killed; empty means nowhere. Fixed when the node starts.
    """

    role: ClassVar[str]
    inputs: ClassVar[Sequence[Topic]]
    output: ClassVar[Topic]
    truth_inputs: ClassVar[Sequence[Topic]] = TRUTH_INPUTS

    def __init__(self, **options: Unpack[NodeOptions]) -> None:
        """Load the module and start listening.

        Raises:
            ValueError: If the module or its weights cannot be loaded, are of another body, or ask for the ground truth
                otherwise than `told` says; or `resume_file` is none.
        """
        super().__init__(self.role, **options)
        self.run = declare_run(self)
        set_threads(declare(self, "threads", 1, described("of PyTorch", fixed=True)))
        which = described("learned, oracle or package.module:Class", fixed=True)
        self._source = declare(self, "module", LEARNED, which)
        weights = declare(self, "weights", "", described("weights file; empty: those that ship"))
        whose = described("the robot's body, of which the weights have to be; empty: any", fixed=True)
        self._body = declare(self, "body", "", whose)
        device = declare(self, "device", "cpu", described("cpu or cuda, such as cuda:0"))
        truth = described("whether it is told the ground truth, 1 or 0; -1: as it asks", fixed=True, low=-1, high=1)
        told = declare(self, "told", AS_IT_ASKS, truth)
        seeds = described("seed of the module's random streams", fixed=True, low=0, high=2**31 - 1)
        self._run_seed = declare(self, "run_seed", 0, seeds)
        self._look_around = 0
        if self.role in LOOKING_ROLES:
            about = "ticks of a look, a turn on the spot; 0: none, -1: those of the body"
            look = described(about, fixed=True, low=OWN_LOOK, high=MOST_TICKS)
            self._look_around = declare(self, "look_around", OWN_LOOK, look)
        self.module, self._driven = self._load(weights, device)
        self.state: Any = None
        """What `step` of the module takes and returns; None before an episode."""
        self._episode = -1
        self.add_on_set_parameters_callback(self._on_parameters)
        self._told = self.asks(self.module)
        check_told(self.role, self._source, self._told, None if told == AS_IT_ASKS else bool(told))
        self._truth = self.truth_inputs if self._told else ()
        self._publisher = self.create_output(self.output)
        about = described("file of what the node remembers, to go on from after a crash; empty: none", fixed=True)
        resume_file = declare(self, "resume_file", "", about)
        self._kept = KeptArrays(Path(resume_file)) if resume_file else None
        if self._kept is not None:
            self._kept.read(self._resume)
        self.open_inputs([*self.inputs, *self._truth])

    def _condition(self) -> Condition:
        condition = super()._condition()
        mark, weights = PRIVILEGED if self._told else "", self.get_parameter("weights").value
        values = {MODULE: f"{self._source}{mark}", WEIGHTS: weights, **condition.values}
        # Summaries of all nodes, as Foxglove's, show the line and none of the values.
        return Condition(f"{condition.message}{mark}", values, condition.warning)

    @abstractmethod
    def step(self, episode: Episode, inputs: dict[str, Any], truth: GroundTruth | None) -> Sequence[Output]:
        """Advance `self.state` by one tick and return what to publish."""

    def check(self, topic: Topic, item: Any) -> None:
        """Refuse the proprioception of another body, such as that of a simulator which was started with one."""
        body = self.driven if topic is topics.PROPRIO else None
        if body is not None and item.shape != (body.proprio_size,):
            said = f"o_pr of the body {body.name} must have shape [{body.proprio_size}], got {[*item.shape]}"
            raise conversions.ConversionError(said)

    def say(self, episode: Episode, value: Any, to_msg: Callable[[Header, Any], Message]) -> Sequence[Output]:
        """Return a tick's answer: a value as the topic's reader has it, and what makes its message of a header."""
        said = Adapted(conversions.stamp_of(episode), value, partial(to_msg, episode.header))
        return [Output(self._publisher, said)]

    def say_torque(self, episode: Episode, torque: NDArray[np.float32]) -> Sequence[Output]:
        """Return a tick's torques, [U], as the answer; the joints have names where the module is of a known body."""
        joints = () if self.driven is None else self.driven.actuated
        to_msg = partial(conversions.torque_to_msg, joints=joints)
        return self.say(episode, conversions.torque_value(torque), to_msg)

    def begin(self, episode: Episode, inputs: dict[str, Any]) -> None:
        """Start `self.state` at the first tick that the module sees of an episode."""
        self.state = self.initial_state(episode.episode)

    def initial_state(self, number: int) -> Any:
        """Return what the node remembers at the start of an episode of a number: any nesting of tuples of arrays."""
        return self.module.initial_state(module_seeds(self._run_seed, np.array([number])))

    def answer(self, stamp: int, episode: Episode, inputs: dict[str, Any], *, insist: bool) -> Sequence[Output] | None:
        """Step the module; an episode's last tick needs no answer."""
        if episode.ended:
            return ()
        if self.state is None or episode.episode != self._episode or episode.step == 0:
            self._episode = episode.episode
            self.begin(episode, inputs)
        inputs = _own(inputs)
        with answering(self.role):
            return self.step(episode, inputs, _ground_truth(inputs) if self._truth else None)

    def start_anew(self) -> None:
        """Forget the state as well, which is of another world."""
        super().start_anew()
        self.state = None

    def keep(self, stamp: int, outputs: Sequence[Output]) -> None:
        """Keep the answer and the state for the process that comes after this one."""
        if self._kept is None or self.state is None:
            return
        arrays: dict[str, Any] = {f"{_LEAF}{i}": leaf for i, leaf in enumerate(leaves(self.state))}
        arrays[_PLACE] = np.array([self._episode, stamp])
        arrays[_ANSWER] = np.frombuffer(b"".join(_serialised(output) for output in outputs), np.uint8)
        self._kept.write(arrays, self)

    def _resume(self, arrays: dict[str, NDArray[Any]]) -> None:
        """Take up what `keep` has kept; a KeyError or ValueError says that it is not that of such a module."""
        number, stamp = arrays[_PLACE].tolist()
        answer = arrays[_ANSWER].tobytes()
        kept = (arrays[f"{_LEAF}{i}"] for i in range(len(arrays) - 2))
        self.state = with_leaves(self.initial_state(number), kept)
        self._episode = number
        self.take_up(stamp, [Output(self._publisher, answer)] if answer else ())

    def _load(self, weights: str, device: str) -> tuple[ModuleT, str | None]:
        """Return the module, and the body that it is of, where it is of one."""
        path = Path(weights) if weights else None
        if self._body:
            path = chosen_weights(self.role, self._source, path, self._body)
        module = load_module(self.role, self._source, path, device)
        if self._body:
            check_body(self.role, module, self._body)
        # `load_module` has checked that it is of the role.
        body = get_body(self._body) if self._body else BALL
        ticks = body.look_ticks if self._look_around == OWN_LOOK else self._look_around
        driven = trained_body(module) or self._body or None
        return cast(ModuleT, look_around(self.prepare(module), ticks, self.scout, body)), driven

    @property
    def driven(self) -> Body | None:
        """The body that the module is of, where it is of one that is known."""
        return None if self._driven is None else BODIES.get(self._driven)

    @property
    def scout(self) -> Scout | None:
        """What says where to look, for a planner that looks around."""
        return None

    def asks(self, module: Module) -> bool:
        """Tell whether a module that `prepare` has returned asks for the ground truth; asked once of each."""
        return bool(module.privileged)

    def prepare(self, module: Module) -> Module:
        """Return the module that was loaded as this node wants it; a ValueError refuses it."""
        return module

    def _on_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        changed = {p.name: p.value for p in parameters}
        if not changed.keys() & {"weights", "device"}:
            return SetParametersResult(successful=True)
        current: dict[str, Any] = {name: self.get_parameter(name).value for name in ("weights", "device")}
        weights, device = (changed.get(name, value) for name, value in current.items())
        try:
            module, driven = self._load(weights, device)
            if self.asks(module) and not self._told:
                raise ValueError(f"weights {weights} need the ground truth: expected to be given when the node starts")
        except (ValueError, OSError, RuntimeError) as error:
            self.counts["refused weights"] += 1
            return SetParametersResult(successful=False, reason=str(error))
        self.module, self._driven, self.state = module, driven, None
        if self._kept is not None:
            # The process after this one begins with the weights of the start, which may remember otherwise.
            self._kept.remove()
            self._kept = None
        self.counts["reloads"] += 1
        self.get_logger().info(f"loaded {weights or 'the weights that ship'} on {device}")
        return SetParametersResult(successful=True)


def _own(inputs: dict[str, Any]) -> dict[str, Any]:
    """Return inputs that the module may write into: the arrays are shared with the other nodes of the process.

    Arrays that cannot be written into would spare 1 us each, but PyTorch warns of them, and Numba compiles anew.
    """
    return {name: value.copy() if isinstance(value, np.ndarray) else value for name, value in inputs.items()}


def _ground_truth(inputs: dict[str, Any]) -> GroundTruth:
    state, pose, twist, boxes, termination = (inputs[topic.name] for topic in TRUTH_INPUTS)
    return GroundTruth(state[None], pose[None], twist[None], boxes[None], np.array([termination.terminated]))


def _serialised(output: Output) -> bytes:
    said = output.message
    return said if isinstance(said, bytes) else serialize_message(message_of(said))
