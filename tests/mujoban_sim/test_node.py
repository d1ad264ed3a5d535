"""What the simulator's node says of itself."""

import pytest
from rclpy.parameter import Parameter
from std_srvs.srv import SetBool, Trigger

from mujoban_msgs_py.runtime.discovery import lock_domain
from mujoban_sim import node as program


@pytest.fixture
def simulator(ros, monkeypatch):
    """The node as its program makes it; it plays two episodes."""
    overrides = [Parameter(name, value=value) for name, value in {"difficulty": 1, "episodes": 2}.items()]
    made = []
    monkeypatch.setattr(program, "run_node", lambda make, args: made.append(make(parameter_overrides=overrides)))
    program.main()
    yield made[0]
    made[0].destroy_node()


def test_a_simulator_that_has_played_all_episodes_says_so_once_and_takes_no_step(simulator, capfd):
    simulator._begin(0)
    simulator._end()
    assert "have been played" not in capfd.readouterr().err
    simulator._end()
    assert capfd.readouterr().err.count("all episodes have been played: 2") == 1
    assert simulator._condition().message == "finished"
    simulator._on_pause(SetBool.Request(data=True), SetBool.Response())
    answer = simulator._on_step(Trigger.Request(), Trigger.Response())
    assert not answer.success and answer.message == "no episode is running"


def test_a_simulator_that_was_started_alone_holds_its_domain_until_it_ends(simulator):
    domain = simulator.context.get_domain_id()
    assert lock_domain(domain) is None
    simulator.destroy_node()
    lock = lock_domain(domain)
    assert lock is not None
    lock.close()
