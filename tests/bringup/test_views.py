"""What tools for looking at the graph receive: standard messages, a Rerun recording, a video."""

import imageio.v2 as imageio
import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Pose
from mujoban_msgs.msg import EpisodeTruth, Instruction
from nav_msgs.msg import OccupancyGrid
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from visualization_msgs.msg import Marker, MarkerArray

from bringup.command import Choice, Solo, Stack
from bringup.overlay import BAR, CELL, COLOURS, MARGIN, grid_picture, name_told
from bringup.players import played, players
from bringup.stack import PlayOptions, play, top_camera_size
from bringup.video import EDGE, VideoNode
from bringup.viz import VizNode, occupancy_grid
from mujoban_core.bodies import get_body
from mujoban_core.camera import FRAME_SIZE
from mujoban_core.grid import AGENT, BOX, TARGET, WALL, cell_to_xy
from mujoban_core.plugins import AGENT as AGENT_ROLE
from mujoban_core.plugins import ROLES
from mujoban_msgs_py import conversions, topics
from mujoban_sim.observation import GLANCE
from mujoban_sim.presets import get_world
from mujoban_sokoban.episodes import Episodes
from mujoban_sokoban.levels import Level

LAYERS = ("wall", "target", "agent", "box")
ENTITIES = {
    "/camera/first_person", "/camera/top_down", "/grid/estimate", "/grid/ground_truth",
    *(f"/grid/{source}/{layer}" for source in ("estimate", "ground_truth") for layer in LAYERS),
    *(f"/grid/{source}/key" for source in ("estimate", "ground_truth")), "/grid/estimate/instruction", "/now",
    "/instruction", "/instructions", "/beta/probability", "/beta/terminated", "/torque", "/reward/step",
    "/reward/return", "/told",
    *(f"/milliseconds/{what}" for what in ("simulator", "estimator", "termination", "planner", "controller")),
}  # fmt: skip


class Listener(Node):
    def __init__(self):
        super().__init__("listener")
        self.grids, self.scenes, self.modules = [], [], {}
        self.create_subscription(OccupancyGrid, "/viz/ground_truth/wall", self.grids.append, 10)
        self.create_subscription(MarkerArray, "/viz/scene", self.scenes.append, 10)
        self.create_subscription(DiagnosticArray, "/diagnostics", lambda m: self.modules.update(players(m, {})), 10)


def test_an_occupancy_grid_begins_in_the_south_west():
    layer = np.zeros((10, 10), np.float32)
    layer[9, 0], layer[0, 9] = 1.0, 0.25
    grid = occupancy_grid(conversions.header(0), layer, 1.0)
    percent = np.array(grid.data).reshape(grid.info.height, grid.info.width)
    assert percent[0, 0] == 100 and percent[9, 9] == 25 and percent.sum() == 125
    south_west = cell_to_xy((9, 0))
    assert grid.info.origin.position.x == south_west[0] - 0.5 and grid.info.origin.position.y == south_west[1] - 0.5
    assert grid.header.frame_id == "map"


def test_standard_tools_see_the_layers_and_the_scene(play_graph):
    episodes = Episodes(1, 47, difficulty=2)
    level = episodes[0].level.abstract_state()
    graph = play_graph(episodes=episodes)
    listener = graph.graph.add(Listener())
    graph.graph.add(VizNode())
    graph.spin_until(lambda: listener.grids and listener.scenes and len(listener.scenes[-1].markers) == 5)
    percent = np.array(listener.grids[-1].data).reshape(10, 10)[::-1]
    assert (percent == 100 * level[..., WALL]).all()
    markers = {marker.ns: marker for marker in listener.scenes[-1].markers}
    assert len(markers["target"].points) == level[..., TARGET].sum()
    assert len(markers["box"].points) == level[..., BOX].sum()
    assert markers["robot"].type == Marker.ARROW


@pytest.mark.parametrize("told", ["planner", ""])
def test_the_scene_of_standard_tools_names_who_is_told_the_truth(play_graph, fresh_weights, told):
    planner = Choice("planner", "oracle") if told else Choice("planner")
    graph = play_graph(Stack(fresh_weights.choices | {"planner": planner}), Episodes(99, 0, difficulty=1))
    listener = graph.graph.add(Listener())
    graph.graph.add(VizNode())
    graph.spin_until(lambda: listener.modules.keys() == ROLES.keys())
    del listener.scenes[:]
    graph.spin_until(lambda: len(listener.scenes) > 2)
    (text,) = [marker for marker in listener.scenes[-1].markers if marker.type == Marker.TEXT_VIEW_FACING]
    assert (text.action == Marker.ADD) == bool(told)
    assert text.action == Marker.DELETE or text.text == "privileged, told the ground truth:\nplanner"


def test_the_live_view_names_torques_by_their_joints_whatever_the_body():
    pytest.importorskip("rerun")
    from bringup.live_layout import torque_curves

    for joints, shown in ((("left", "right"), ["left", "right"]), ((), ["1", "2"])):
        curves = torque_curves(joints, 2)
        assert curves.names is not None and curves.names.as_arrow_array().to_pylist() == shown


@pytest.mark.parametrize("body", ["ball", "ant"])
def test_a_recording_of_the_live_view_holds_every_entity(
    play_graph, oracles, ant_teacher, body, tmp_path
):
    chunk = pytest.importorskip("rerun.chunk")
    from bringup.live import LiveNode

    file = tmp_path / "play.rrd"
    driver = {"controller": Choice("controller", weights=ant_teacher)} if body == "ant" else {}
    stack = Stack(oracles.choices | driver, body=body)
    # An untrained teacher drives the ant, up to the time limit.
    graph = play_graph(stack, Episodes(1, 0, difficulty=1), **({"time_limit": 25} if driver else {}))
    graph.graph.add(LiveNode(parameter_overrides=[Parameter("save", value=str(file))]))
    graph.finish()
    graph.__exit__(None, None, None)
    assert {part.entity_path for part in chunk.RrdReader(str(file)).stream()} >= ENTITIES


def test_a_recording_of_the_live_view_names_at_every_moment_who_is_told_the_truth(play_graph, fresh_weights, tmp_path):
    chunk = pytest.importorskip("rerun.chunk")
    from bringup.live import LiveNode

    file = tmp_path / "play.rrd"
    graph = play_graph(fresh_weights, Episodes(1, 0, difficulty=1), time_limit=40)
    graph.graph.add(LiveNode(parameter_overrides=[Parameter("save", value=str(file))]))
    graph.finish()
    graph.__exit__(None, None, None)
    parts = [part for part in chunk.RrdReader(str(file)).stream() if part.entity_path == "/told"]
    assert all(part.is_static for part in parts), "it holds for the whole recording"
    said = [row for part in parts for row in part.to_record_batch().to_pylist()]
    latest = max(said, key=lambda row: row["rerun.controls.RowId"])
    assert latest["TextDocument:text"] == ["**privileged, told the ground truth: planner**"]


def test_a_map_tells_robot_box_and_solved_box_apart_and_shows_the_target_below():
    state = Level.from_text("######\n#+$*.#\n#   $#\n######\n").abstract_state()
    picture = grid_picture(state, 16)
    row, left = np.argwhere(state[..., AGENT])[0]
    cells = [picture[16 * row : 16 * row + 16, 16 * c : 16 * c + 16].reshape(-1, 3) for c in range(left, left + 4)]
    shown = [{name for name, colour in COLOURS.items() if (cell == colour).all(-1).any()} for cell in cells]
    assert shown == [{"robot", "target"}, {"box"}, {"box on a target", "target"}, {"target"}]


def test_the_live_view_names_instruction_and_modules_and_marks_those_that_are_told_the_truth():
    pytest.importorskip("rerun")
    from bringup.live_layout import Shown, text, told

    truth = EpisodeTruth(episode=2, seed=7, difficulty=3, level="#@$.*#", step=40, boxes_on_target=1)
    teacher = played("learned (privileged)", "/home/me/teacher.safetensors")
    modules = {"planner": "oracle", "controller": teacher, "estimator": "learned"}
    shown = text(Shown(Instruction(sequence=4, direction=Instruction.WEST), truth, modules))
    assert shown.startswith("# ← west\n")
    for part in ("| 2: seed 7, difficulty 3 |", "| 2.0 s |", "| 1 of 2 boxes |", "| **oracle** |", "| learned |"):
        assert part in shown
    assert "| **learned teacher.safetensors (privileged)** |" in shown and "| termination | not heard yet |" in shown
    assert told(modules) == (
        "**privileged, told the ground truth: planner, controller**\n\nnot heard yet: termination"
    )
    assert told(dict.fromkeys(ROLES, "learned")) == "nobody"
    agent = {"agent": "mine:Drive (privileged)"}
    alone = text(Shown(None, truth, agent))
    assert "| agent | **mine:Drive (privileged)** |" in alone and "planner" not in alone
    assert told(agent) == "**privileged, told the ground truth: agent**"


def test_what_a_later_run_does_not_play_is_forgotten():
    def said(**modules):
        statuses = [
            DiagnosticStatus(name=f"/{role}", values=[KeyValue(key="module", value=module)])
            for role, module in modules.items()
        ]
        return DiagnosticArray(status=statuses)

    told = players(said(planner="oracle (privileged)", simulator="running"), {})
    both = players(said(estimator="learned"), told)
    assert both == {"planner": "oracle (privileged)", "estimator": "learned"}
    assert players(DiagnosticArray(status=[DiagnosticStatus(name="/simulator")]), both) == both
    agent = players(said(agent="random"), both)
    assert agent == {"agent": "random"} and players(said(planner="learned"), agent) == {"planner": "learned"}


def test_a_video_shows_both_views_and_what_the_modules_say(play_graph, tmp_path):
    file = tmp_path / "film.mp4"
    episodes = Episodes(1, 0, difficulty=1)
    graph = play_graph(episodes=episodes)
    video = graph.graph.add(VideoNode(file))
    (result,) = graph.finish()
    graph.spin_until(lambda: video.written == graph.monitor.stamp)
    graph.__exit__(None, None, None)
    frames = [np.asarray(frame) for frame in imageio.get_reader(file)]
    assert len(frames) == result.steps + 1, "one frame a tick, and one of the end"
    assert {frame.shape for frame in frames} == {(EDGE, 2 * EDGE, 3)}
    middle = CELL // 2 + CELL * np.arange(10)
    drawn = frames[0][MARGIN + middle[:, None], MARGIN + middle].astype(int)
    estimate = grid_picture(episodes[0].level.abstract_state())[middle[:, None], middle].astype(int)
    assert np.abs(drawn - estimate).max() < 60, "the map shows the estimate, but for what compression does to colours"
    line = frames[0][-BAR:, :EDGE]
    assert (line > 200).any() and (line < 40).any(), "the instruction is written at the bottom"
    assert not (frames[0][-BAR:, EDGE:] == frames[0][-BAR:, :EDGE]).all()


def test_a_video_names_who_is_told_the_truth_and_nobody_where_nobody_is(tmp_path):
    last = {}
    oracles = Stack({role: Choice(role, "oracle") for role in ROLES})
    learned = Stack({role: Choice(role) for role in ROLES})
    for name, player in (("told", oracles), ("learned", learned)):
        file = tmp_path / f"{name}.mp4"
        play(player, Episodes(1, 0, difficulty=1), PlayOptions(time_limit=4, video=file))
        (*_, last[name]) = (np.asarray(frame)[-BAR:, EDGE:].astype(int) for frame in imageio.get_reader(file))
    yellow = [((line[..., :2] > 160) & (line[..., 2:] < 120)).all(-1).sum() for line in last.values()]
    assert yellow[0] > 100 and yellow[1] == 0
    told, nobody = (name_told(np.full((EDGE, EDGE, 3), 90, np.uint8), roles) for roles in (["estimator"], []))
    assert (told[: EDGE - BAR] == 90).all() and (told[EDGE - BAR :] < 40).any() and (nobody == 90).all()


@pytest.mark.parametrize(("reliability", "period"), [("BEST_EFFORT", GLANCE), ("RELIABLE", 1)])
def test_the_view_from_above_is_drawn_as_often_as_its_readers_need(play_graph, reliability, period):
    graph = play_graph(episodes=Episodes(4, 0, difficulty=2))
    node = graph.graph.add(Node("watcher"))
    stamps = []
    qos = QoSProfile(depth=1000, reliability=ReliabilityPolicy[reliability])
    topic = topics.TOP_CAMERA
    node.create_subscription(topic.type, topic.name, lambda m: stamps.append(conversions.stamp_of(m)), qos)
    graph.spin_until(lambda: len(stamps) > 12)
    shown = list(dict.fromkeys(stamps[4:]))
    # On a busy machine a tick stays without an answer and is published again; else each is once.
    assert len(stamps[4:]) - len(shown) <= graph.simulator.counts["repeated ticks"]
    assert set(np.diff(shown)) == {period * topics.TICK}


def test_who_follows_a_glance_at_the_view_from_above_may_need_all_of_it(play_graph):
    graph = play_graph(episodes=Episodes(4, 0, difficulty=2))
    node, topic = graph.graph.add(Node("watcher")), topics.TOP_CAMERA
    for reliability, period in (("BEST_EFFORT", GLANCE), ("RELIABLE", 1)):
        stamps = []
        qos = QoSProfile(depth=1000, reliability=ReliabilityPolicy[reliability])
        heard = node.create_subscription(
            topic.type, topic.name, lambda m, stamps=stamps: stamps.append(conversions.stamp_of(m)), qos
        )
        graph.spin_until(lambda stamps=stamps: len(stamps) > 8)
        assert set(np.diff(list(dict.fromkeys(stamps[4:])))) == {period * topics.TICK}
        node.destroy_subscription(heard)
        before = graph.simulator.ticks
        graph.spin_until(lambda before=before: graph.simulator.ticks > before + 2)


def test_the_view_from_above_has_as_many_pixels_to_a_metre_with_every_body():
    modules = {role: Choice(role, "oracle") for role in ROLES}
    ball, ant = (top_camera_size(Stack(modules, body=body), filmed=False) for body in ("ball", "ant"))
    assert (ball, ant) == (FRAME_SIZE, 3 * FRAME_SIZE)
    assert top_camera_size(Stack(modules, body="ant"), filmed=True) == EDGE
    agent = Solo(Choice.parse(AGENT_ROLE, "random"), body="ant")
    assert top_camera_size(agent, filmed=True) == FRAME_SIZE, "it may look at it"


def test_the_scene_has_the_sizes_of_the_body_and_the_world(ros):
    chosen = {"body": "ant", "world": "reference"}
    node = VizNode(parameter_overrides=[Parameter(name, value=value) for name, value in chosen.items()])
    try:
        cell = get_body("ant").cell_size
        node._boxes = [Pose()]
        state = np.zeros((10, 10, 4), np.float32)
        state[0, 9, WALL] = 1.0
        markers = {marker.ns: marker for marker in node._markers(conversions.header(0), state)}
        wall, box = markers["wall"], markers["box"]
        assert (wall.scale.x, wall.scale.z) == (cell, get_world("reference").drawn_wall_height * cell)
        assert (wall.points[0].x, wall.points[0].y) == tuple(cell_to_xy((0, 9), cell))
        assert (box.scale.x, box.scale.z) == pytest.approx((0.8 * cell, 0.3 * cell))
        assert occupancy_grid(conversions.header(0), state[..., WALL], cell).info.resolution == np.float32(cell)
    finally:
        node.destroy_node()
