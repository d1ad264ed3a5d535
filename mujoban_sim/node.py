"""The simulator node: publishes o_t, waits for A_t and a_t, and steps the world (`python -m mujoban_sim.node`)."""

from __future__ import annotations

if __name__ == "__main__":
    from mujoban_core.early import end_at_once

    end_at_once()

import time
from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

from mujoban_core.grid import CONTROL_PERIOD
from mujoban_core.signals import leave
from mujoban_msgs_py import conversions, topics
from mujoban_msgs_py.checks import ConversionError
from mujoban_msgs_py.listening import Received, listen
from mujoban_msgs_py.runtime.descriptors import NodeOptions, declare, declare_run
from mujoban_msgs_py.runtime.diagnostics import Condition, report_on
from mujoban_msgs_py.runtime.discovery import lock_domain
from mujoban_msgs_py.runtime.graph_node import GraphNode
from mujoban_msgs_py.runtime.kept import KeptArrays
from mujoban_msgs_py.runtime.pace import Pace
from mujoban_msgs_py.runtime.tick_node import live_qos, run_node
from mujoban_msgs_py.seldom import is_due
from mujoban_msgs_py.topics import TICK, Topic
from mujoban_sim.node_parameters import PARAMETERS, episodes_of
from mujoban_sim.observation import ObservationPublisher
from mujoban_sim.resume import Moment, Place
from mujoban_sim.tick_messages import TickLabel
from mujoban_sim.world import World

MATCH_PERIOD = 0.02
"""Seconds between two looks at whether the graph is complete."""


class SimulatorNode(GraphNode):
    """Plays episodes, in lockstep with the graph or in real time.

    In lockstep the world steps when the torque and the instruction of the current stamp have arrived, so a run
    is deterministic. In real time it steps when the clock says so, and holds the latest torque for `hold_limit` ticks.

    Parameters:
        seed, episodes, difficulty, level_file: Which episodes are played, see `mujoban_sokoban.episodes.Episodes`;
            `seed` -1 and `episodes` 0 mean what None does there.
        time_limit: Steps of an episode; 0 means that of the body.
        body, world: The robot's body, and the physical world, see `mujoban_sim.presets`.
        realtime: Simulated seconds per second; 0 is lockstep.
        resend_after: Seconds without an answer after which a tick is offered again.
        hold_limit: Ticks for which the latest torque is held in real time, after which the clock waits for another.
        await_recorder, await_monitor: Whether a tick, in real time the first, waits until that one has acknowledged it.
        instructed: Whether instructions come with the torques; those who play without modules send torques alone.
        top_camera_size: Pixels along the edge of `/camera_top/image_raw`, which is drawn while it has a reader.
        run: Identifier of the run, from 0 on: nanoseconds of simulated time at which it begins.
        resume_file: Where the node keeps every tick that it offers, to go on from after a crash; empty means nowhere.

    Services: `/reset` starts the episode again, `/pause` (true or false) holds the world, `/step` advances it a tick.

    Attributes:
        counts: Events that a user should know of: late answers, rejected torques and so on.
        finished: Done when the last episode has ended.
        ticks: Steps of the world so far.
        pace: The clock of real time, and how long answers take.
    """

    def __init__(self, **options: Unpack[NodeOptions]) -> None:
        """Read the parameters and make the world; the first tick follows once the graph is complete.

        Raises:
            ParameterException: If a parameter is out of its range.
            ValueError: If a body or world is unknown or the level file is malformed.
            OSError: If the level file cannot be read.
            RenderingError: If there is no OpenGL.
        """
        super().__init__("simulator", **options)
        self.counts: Counter[str] = Counter()
        self.finished, self.ticks = Future(), 0
        self._settings: dict[str, Any] = {name: declare(self, name, *about) for name, about in PARAMETERS.items()}
        self.run = declare_run(self, 0)
        self.episodes = episodes_of(self._settings)
        self.world = World(
            1,
            body=self._settings["body"],
            world=self._settings["world"],
            max_boxes=self.episodes.max_boxes,
            time_limit=self._settings["time_limit"] or None,
        )
        self._speed: float = self._settings["realtime"]
        if not self._speed >= 0:
            raise ValueError(f"realtime is {self._speed}: expected a speed above 0, or 0 for lockstep")
        self._observation = ObservationPublisher(self, self.world, self._settings["top_camera_size"])
        self._place = Place(stamp=self.run)
        self._torque: NDArray[np.float32] | None = None
        self._held_torque = np.zeros(self.world.body.action_size, np.float32)
        self._first = 0  # stamp of the episode's first tick, before which no answer is meant for it
        self._instruction: conversions.InstructionReading | None = None
        self._instructed = -1  # stamp of the newest instruction so far: an older one that comes late is over
        self._in_force = conversions.InstructionReading(0, 0)
        awaited = {"await_recorder": topics.RECORDED, "await_monitor": topics.MONITORED}
        self._witnesses = [topic for name, topic in awaited.items() if self._settings[name]]
        self._unconfirmed: set[Topic] = set()
        self._paused = False
        self._steps_due = 0
        self._started: float | None = None
        path = self._settings["resume_file"]
        self._kept = KeptArrays(Path(path)) if path else None
        self._resumed = self._restore()
        # What is missing to draw with shows now, and the first tick is as quick as the others.
        self.world.render()
        self.pace = Pace(self._speed, self._settings["resend_after"], self._settings["hold_limit"], newest=self.run)
        self._listen()
        report_on(self, self._condition)
        self._start_timer = self.create_timer(MATCH_PERIOD, self._start_when_complete)

    @property
    def _over(self) -> bool:
        return self.ended or self.finished.done()

    @property
    def _stamp(self) -> int:
        return self._place.stamp

    @property
    def seconds(self) -> float:
        """Wall time since the first tick."""
        return 0.0 if self._started is None else time.perf_counter() - self._started

    def _listen(self) -> None:
        listen(self, topics.TORQUE, self._on_torque, otherwise=self._no_torque)
        # What a planner said before this simulator came must not arrive.
        listen(self, topics.INSTRUCTION, self._on_instruction, qos=live_qos())
        for topic in self._witnesses:
            listen(self, topic, partial(self._on_confirmed, topic))
        self.create_service(Trigger, "/reset", self._on_reset)
        self.create_service(SetBool, "/pause", self._on_pause)
        self.create_service(Trigger, "/step", self._on_step)

    # Starting

    def _start_when_complete(self) -> None:
        """Begin once the modules listen and answer, and the witnesses as well."""
        needed = (topics.TORQUE, *[topics.INSTRUCTION] * self._settings["instructed"], *self._witnesses)
        answering = all(self.count_publishers(self.resolve_topic_name(topic.name)) for topic in needed)
        if not (answering and self._observation.matched(everything=topics.RECORDED in self._witnesses)):
            return
        self._start_timer.cancel()
        self._started = time.perf_counter()
        if self._resumed:
            self._offer()
            self._proceed()  # past an episode's last tick, which no module answers
        else:
            self._begin(self._place.index)
        self.create_timer(self._settings["resend_after"] / 2, self._offer_again)
        if self._speed > 0:
            self.create_timer(CONTROL_PERIOD / self._speed, self._on_clock)

    def _restore(self) -> bool:
        """Take up the moment that an earlier process has left, or the first episode; return whether there was one."""
        moment = None if self._kept is None else self._kept.read(Moment.of)
        if moment is None:
            self.world.reset([0], [self.episodes[0]])
            return False
        self._place, self._held_torque = moment.place, moment.torque
        self._in_force = conversions.InstructionReading(moment.place.sequence, moment.place.direction)
        self.world.restore([0], moment.world)
        return True

    def _keep(self) -> None:
        if self._kept is not None:
            moment = Moment(self._place, self._held_torque, dict(self.world.snapshot([0])))
            self._kept.write(moment.arrays(), self)

    # Ticks

    def _begin(self, index: int) -> None:
        self._place = self._place._replace(index=index, starts=self._place.starts + 1)
        self.world.reset([0], [self.episodes[index]])
        self._held_torque = np.zeros_like(self._held_torque)  # others share what a message holds
        self._in_force = conversions.InstructionReading(0, 0)
        self._first = self._stamp + TICK
        self._next()

    def _next(self) -> None:
        """Go on to the next tick."""
        sequence, direction = self._in_force
        self._place = self._place._replace(stamp=self._stamp + TICK, sequence=sequence, direction=direction)
        self._keep()
        self._offer()

    def _offer(self) -> None:
        """Publish the tick and wait for what the modules make of it."""
        self._torque = self._instruction = None
        self._unconfirmed.update(self._witnesses)
        self.pace.offer(self._stamp, time.perf_counter())
        self._publish()

    def _publish(self) -> None:
        self._offered = time.perf_counter()
        label = TickLabel(self._stamp, self._place.starts, self.episodes.difficulty, self._in_force.sequence)
        self._observation.publish(label)

    def _offer_again(self) -> None:
        """Repeat a tick that stays without an answer: a node may have been started since."""
        waited = time.perf_counter() - self._offered > self._settings["resend_after"]
        if waited and not (self._answered or self._over or self.pace.running):
            self.counts["repeated ticks"] += 1
            self._publish()

    @property
    def _ended(self) -> bool:
        return bool(self.world.done[0])

    @property
    def _answered(self) -> bool:
        """Whether nothing is missing to go on; an episode's last tick needs no answer."""
        told = self._instruction is not None or not self._settings["instructed"]
        return not self._unconfirmed and (self._ended or (self._torque is not None and told))

    def _proceed(self) -> None:
        """In lockstep, go on as soon as the tick has been answered."""
        while not self._over and self._speed == 0 and self._answered and self._may_step():
            self._advance()

    def _may_step(self) -> bool:
        if not self._paused:
            return True
        if self._steps_due == 0:
            return False
        self._steps_due -= 1
        return True

    def _on_clock(self) -> None:
        now = time.perf_counter()
        if self._over:
            return
        if self.pace.falls_silent(now, answered=self._answered):
            self._reject("waits of the clock", f"no torque for {self.pace.patience} s: the clock waits for one")
        waits = self.pace.outruns(self._stamp) and not self._ended
        if not (self.pace.running and (waits or self._may_step())):
            self.pace.start(now)
            return
        if (complaint := self.pace.complaint(now)) is not None:
            self.get_logger().warning(complaint)
        if not waits:
            self._advance()

    def _advance(self) -> None:
        """Apply the tick's answers and offer the next tick, of this episode or of the next."""
        if self._ended:
            self._end()
            return
        if self._torque is None:
            self.counts["late answers"] += 1
        else:
            self._held_torque = self._torque
        if self._instruction is not None:
            issued = self._instruction != self._in_force
            self._in_force = self._instruction
            self.world.instruct(np.array([self._in_force.direction]), np.array([issued]))
        self.world.step(self._held_torque[None])
        self.ticks += 1
        self.pace.tick(late=self._torque is None)
        self._next()

    def _end(self) -> None:
        following = self._place.index + 1
        if following < len(self.episodes):
            self._begin(following)
        else:
            self.finished.set_result(None)

    # Answers

    def _no_torque(self, error: ConversionError) -> NDArray[np.float32]:
        """Return what is held for a controller that says nonsense: zero."""
        self._reject("rejected torques", f"rejected a torque, zero is held instead: {error}")
        return np.zeros_like(self._held_torque)

    def _on_torque(self, message: Received) -> None:
        torque, expected = message.content, self._held_torque.shape
        if torque.shape != expected:
            said = f"torque must have shape {[*expected]}, got {[*torque.shape]}"
            torque = self._no_torque(ConversionError(said))
        if not self._is_known(message.stamp, topics.TORQUE.name):
            return
        self.pace.hear(message.stamp, time.perf_counter())
        if message.stamp == self._stamp:
            self._torque = torque
            self._proceed()
        elif self._speed > 0 and self._torque is None and message.stamp >= self._first:
            self._held_torque = torque

    def _on_instruction(self, message: Received) -> None:
        if not self._is_known(message.stamp, topics.INSTRUCTION.name):
            return
        late = self._speed > 0 and message.stamp >= self._first and message.stamp > self._instructed
        if message.stamp == self._stamp or late:
            self._instruction, self._instructed = message.content, message.stamp
            self._proceed()

    def _on_confirmed(self, topic: Topic, message: Received) -> None:
        if message.stamp == self._stamp:
            self._unconfirmed.discard(topic)
            self._proceed()

    def _is_known(self, stamp: int, topic: str) -> bool:
        """Tell whether a stamp is that of a tick of this run; repeated answers to earlier ticks are."""
        if self.run < stamp <= self._stamp:
            return True
        self._reject("messages of an unknown episode", f"{topic}: stamp {stamp} ns belongs to no episode of this run")
        return False

    def _condition(self) -> Condition:
        """Return what /diagnostics says of this node."""
        rate = self.ticks / self.seconds if self.seconds else 0.0
        values = {"ticks": self.ticks, "ticks/s": f"{rate:.1f}", "answer ms, p99": f"{self.pace.answer_ms(99):.1f}"}
        values |= {"episode": self._place.starts, **self.counts}
        if self.finished.done():
            return Condition("finished", values)
        if self._started is None:
            return Condition("waiting for the graph to be complete", values)
        if not self.pace.kept:
            return Condition("real time is not kept", values, warning=True)
        return Condition("paused" if self._paused else "running", values)

    def _reject(self, kind: str, reason: str) -> None:
        self.counts[kind] += 1
        if is_due(self, kind):
            self.get_logger().error(reason)

    # Services

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        running = self._started is not None and not self.finished.done()
        response.success = running and not self._ended
        if response.success:
            self.counts["resets"] += 1  # who plays a level twice does better
            self._begin(self._place.index)
            spec = self.episodes[self._place.index]
            response.message = f"episode {self._place.starts} starts with seed {spec.seed}"
        else:
            response.message = "the episode has ended, the next one follows" if running else "no episode is running"
        return response

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._paused, self._steps_due = request.data, 0
        response.success, response.message = True, "paused" if request.data else "running"
        self._proceed()
        return response

    def _on_step(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = self._paused and not self.finished.done()
        if self.finished.done():
            response.message = "no episode is running"
        else:
            response.message = "one tick" if self._paused else "not paused: call /pause first"
        if response.success:
            self._steps_due += 1
            self._proceed()
        return response


class _OwnProcess(SimulatorNode):
    def __init__(self, **options: Unpack[NodeOptions]) -> None:
        super().__init__(**options)
        # A graph that is started later takes another domain; one that has started this process holds it already.
        self._domain = lock_domain(self.context.get_domain_id())

    def destroy_node(self) -> None:
        if self._domain is not None:
            self._domain.close()
        super().destroy_node()

    def _end(self) -> None:
        super()._end()
        if self.finished.done():  # in one process with a monitor, which shows results, the line would only disturb
            self.get_logger().info(f"all episodes have been played: {len(self.episodes)}")


def main(args: Sequence[str] | None = None) -> int:
    """Run the node; without OpenGL it ends with one line on stderr and status 2, as for other bad input."""
    return run_node(_OwnProcess, args)


if __name__ == "__main__":
    leave(main())
