"""What all nodes of the graph have in common: an end, timers on wall time, outputs, services that no request breaks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Unpack

from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.parameter_service import ParameterService
from rclpy.service import Service
from rclpy.timer import Timer

from mujoban_msgs_py.listening import reject
from mujoban_msgs_py.runtime.descriptors import RclpyOptions
from mujoban_msgs_py.runtime.intra_process import IntraProcess, TopicPublisher
from mujoban_msgs_py.topics import Topic


class GraphNode(Node):
    """A node that ends, keeps its own time, and refuses what it cannot answer.

    An `EventsExecutor` runs at most one callback in a `spin_once` and keeps the others queued; those of a node that is
    removed and destroyed meanwhile run all the same, on publishers that are gone.

    Attributes:
        ended: Whether it was destroyed; callbacks of subscriptions ask for it themselves.
        intra_process: Hands over messages between nodes of this process, if they do not go through the middleware.
    """

    ended = False

    def __init__(
        self, name: str, *, intra_process: IntraProcess | None = None, **options: Unpack[RclpyOptions]
    ) -> None:
        """Make the node."""
        self.intra_process = intra_process
        super().__init__(name, **options)
        if self.intra_process is not None:
            self.intra_process.join(self)

    def destroy_node(self) -> None:
        """End the node; what an executor still has in its queue for it is left alone."""
        self.ended = True
        if self.intra_process is not None:
            self.intra_process.leave(self)
        super().destroy_node()

    def create_output(self, topic: Topic) -> TopicPublisher:
        """Return a publisher of a topic of the graph."""
        return TopicPublisher(self, topic, self.intra_process)

    def create_timer(
        self, timer_period_sec: float, callback: Callable[[], object], *args: Any, **options: Any
    ) -> Timer:
        """Make a timer as `rclpy.node.Node` does; it stands still once the node was destroyed.

        Unless a clock is given, it goes by wall time whatever `use_sim_time` says: simulated time stands still without
        the simulator's own timers, and a clock that is set back must not hold it up.
        """

        def call() -> None:
            if not self.ended:
                callback()

        if len(args) < 2:
            options.setdefault("clock", Clock(clock_type=ClockType.STEADY_TIME))
        return super().create_timer(timer_period_sec, call, *args, **options)

    def create_service(
        self, srv_type: type[Any], srv_name: str, callback: Callable[[Any, Any], Any], **options: Any
    ) -> Service:
        """Offer a service as `rclpy.node.Node` does; a request that rclpy's own ones raise an error for is refused.

        They do for parameters of a type that there is not, or whose text is none, and would end the process with it.
        """
        if not isinstance(getattr(callback, "__self__", None), ParameterService):
            return super().create_service(srv_type, srv_name, callback, **options)

        def answer(request: Any, response: Any) -> Any:
            try:
                return callback(request, response)
            except Exception as error:
                reject(self, f"/{srv_name}", error)
                return _refuse(request, response, str(error))

        return super().create_service(srv_type, srv_name, answer, **options)


def _refuse(request: Any, response: Any, reason: str) -> Any:
    """Return a response that says, where it can, that what was not yet done is not done."""
    refused = SetParametersResult(successful=False, reason=reason)
    if hasattr(response, "results"):
        response.results.extend(refused for _ in request.parameters[len(response.results) :])
    elif isinstance(getattr(response, "result", None), SetParametersResult):
        response.result = refused
    return response
