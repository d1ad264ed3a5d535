"""The `ros2` command, run as a user runs it, against real nodes."""

import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import redirect_stderr, redirect_stdout, suppress
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseArray
from mcap.writer import Writer as McapWriter
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import CameraInfo, JointState
from std_msgs.msg import String
from std_srvs.srv import SetBool

from mujoban_msgs_py import conversions, topics
from mujoban_msgs_py.bags import BagWriter, open_bag
from mujoban_msgs_py.bags.errors import BagError
from mujoban_msgs_py.bags.training import find_bags
from mujoban_msgs_py.ros2 import topic_pub
from mujoban_msgs_py.ros2.main import run
from mujoban_msgs_py.ros2.messages import fill, to_csv, to_yaml
from mujoban_msgs_py.ros2.session import CommandError, Session
from mujoban_msgs_py.ros2.topic_measure import Bandwidth
from mujoban_msgs_py.runtime.descriptors import described

COMMAND = [sys.executable, "-m", "mujoban_msgs_py.ros2.main"]


def start(*arguments):
    # A shell ignores interrupts in what it runs in the background, and children inherit that.
    return subprocess.Popen(
        [*COMMAND, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip


def ros2(*arguments, status=0):
    """Run the command in this process, which spares the time to start one; returns stdout, or stderr if it fails."""
    # Real files, since the executor hands stderr's descriptor to the fault handler.
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
        with redirect_stdout(out), redirect_stderr(err):
            try:
                result = run(arguments)
            except SystemExit as leaving:
                result = leaving.code
        texts = [(file.seek(0), file.read())[1] for file in (out, err)]
    assert result == status, texts[1]
    return texts[1] if status else texts[0]


@pytest.fixture(scope="module")
def talker():
    """A node with parameters and a service that publishes a pose 50 times a second."""
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("talker", context=context)
    node.declare_parameter("speed", 1.5, described("of travel", low=0.0, high=9.0))
    node.declare_parameter("name", "ball")
    pose = node.create_publisher(topics.POSE.type, topics.POSE.name, topics.POSE.qos)
    episode = node.create_publisher(topics.EPISODE.type, topics.EPISODE.name, topics.EPISODE.qos)
    reading = conversions.EpisodeReading(7, 0, False)
    episode.publish(conversions.episode_to_msg(conversions.header(5), reading))
    node.heard = []
    node.create_subscription(String, "/chatter", lambda m: node.heard.append(m.data), 10)
    node.count = 0

    def publish():
        node.count += 1
        pose.publish(conversions.pose_to_msg(conversions.header(node.count * topics.TICK, "map"), (1.0, 2.0, 0.0)))

    def serve(request, response):
        response.success, response.message = request.data, f"was asked {request.data}"
        return response

    node.create_timer(0.02, publish)
    node.create_service(SetBool, "/pause", serve)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)

    def spin():
        with suppress(ExternalShutdownException):
            executor.spin()

    thread = threading.Thread(target=spin, daemon=True)
    thread.start()
    yield node
    executor.shutdown()
    thread.join(10)
    node.destroy_node()
    context.try_shutdown()


def test_lists_topics_with_their_types(talker):
    assert {"/chatter", "/episode", "/pose"} <= set(ros2("topic", "list").splitlines())
    assert "/pose [geometry_msgs/msg/PoseStamped]" in ros2("topic", "list", "-t").splitlines()


def test_info_counts_publishers_and_names_them(talker):
    text = ros2("topic", "info", "-v", "/pose")
    assert text.startswith("Type: geometry_msgs/msg/PoseStamped\n\nPublisher count: 1\n\nNode name: talker\n")
    assert "Reliability: RELIABLE" in text and "Subscription count: 0" in text


def test_echo_prints_yaml_fields_and_csv(talker):
    text = ros2("topic", "echo", "--once", "/pose")
    assert re.match(r"header:\n  stamp:\n    sec: \d+\n    nanosec: \d+\n  frame_id: map\npose:\n  position:\n", text)
    assert text.endswith("    w: 1.0\n---\n")
    assert ros2("topic", "echo", "--once", "--field", "pose.position", "/pose") == "x: 1.0\ny: 2.0\nz: 0.0\n---\n"
    assert ros2("topic", "echo", "--once", "--csv", "/pose").endswith("map,1.0,2.0,0.0,0.0,0.0,0.0,1.0\n")


def test_echo_receives_what_a_latched_topic_said_earlier(talker):
    assert ros2("topic", "echo", "--once", "--field", "episode", "/episode") == "7\n---\n"


def test_hz_measures_the_rate(talker):
    process = start("topic", "hz", "/pose")
    lines = [process.stdout.readline() for _ in range(2)]
    process.send_signal(signal.SIGINT)
    assert process.wait(30) == 2
    rate = float(re.fullmatch(r"average rate: (\d+\.\d{3})\n", lines[0])[1])
    assert 10 < rate < 60
    assert re.fullmatch(r"\tmin: \d\.\d{3}s max: \d\.\d{3}s std dev: \d\.\d{5}s window: \d+\n", lines[1])


def test_pub_reaches_a_subscriber(talker):
    text = ros2("topic", "pub", "--once", "/chatter", "std_msgs/msg/String", "{data: hello}")
    assert "publisher: beginning loop\npublishing #1: std_msgs.msg.String(data='hello')\n" in text
    # The command may be over before the talker's executor comes to the message.
    deadline = time.monotonic() + 10.0
    while not talker.heard and time.monotonic() < deadline:
        time.sleep(0.01)
    assert talker.heard == ["hello"]


@pytest.mark.parametrize(
    ("kind", "values", "before"),
    [
        ("geometry_msgs/msg/PoseStamped", "{header: auto}", "header=std_msgs.msg.Header("),
        ("std_msgs/msg/Header", "{stamp: now}", "std_msgs.msg.Header("),
    ],
)
def test_pub_stamps_with_the_time_where_it_is_asked_to(kind, values, before):
    sent_at = time.time()
    text = ros2("topic", "pub", "--once", "-w", "0", "--keep-alive", "0", "/stamped", kind, values)
    stamp = re.search(rf"{re.escape(before)}stamp=builtin_interfaces\.msg\.Time\(sec=(\d+), nanosec=\d+\)", text)
    assert stamp is not None and int(sent_at) <= int(stamp[1]) <= time.time()


def test_pub_keeps_to_its_rate_whatever_a_message_takes(monkeypatch):
    now, waited = [0.0], []

    def spin_for(_, seconds):
        waited.append(seconds)
        now[0] += max(0.0, seconds) + 0.02

    monkeypatch.setattr(Session, "spin_for", spin_for)
    monkeypatch.setattr(topic_pub, "time", SimpleNamespace(monotonic=lambda: now[0]))
    ros2("topic", "pub", "-r", "10", "-t", "5", "-w", "0", "--keep-alive", "0", "/quiet", "std_msgs/msg/String")
    assert waited == pytest.approx([0.1, 0.08, 0.08, 0.08, 0.0])


def test_nodes_are_listed_and_described(talker):
    assert "/talker" in ros2("node", "list").splitlines()
    text = ros2("node", "info", "/talker")
    assert text.startswith("/talker\n  Subscribers:\n    /chatter: std_msgs/msg/String\n")
    assert "    /pose: geometry_msgs/msg/PoseStamped\n" in text and "    /pause: std_srvs/srv/SetBool\n" in text


def test_parameters_are_listed_read_and_set(talker):
    assert {"  speed", "  name"} <= set(ros2("param", "list", "/talker").splitlines())
    assert ros2("param", "get", "/talker", "speed") == "Double value is: 1.5\n"
    assert ros2("param", "set", "/talker", "speed", "2.5") == "Set parameter successful\n"
    assert talker.get_parameter("speed").value == 2.5
    assert ros2("param", "set", "/talker", "speed", "fast") == "", "a refusal goes to stderr, with status 0"
    assert talker.get_parameter("speed").value == 2.5
    text = ros2("param", "describe", "/talker", "speed")
    expected = "Parameter name: speed\n  Type: double\n  Description: of travel\n  Constraints:\n    Min value: 0.0\n"
    assert text.startswith(expected)
    assert "/talker:\n  ros__parameters:\n    name: ball\n    speed: 2.5\n" in ros2("param", "dump", "/talker")


def test_services_are_listed_and_called(talker):
    assert "/pause [std_srvs/srv/SetBool]" in ros2("service", "list", "-t").splitlines()
    text = ros2("service", "call", "/pause", "std_srvs/srv/SetBool", "{data: true}")
    assert "requester: making request: std_srvs.srv.SetBool_Request(data=True)\n\nresponse:\n" in text
    assert "std_srvs.srv.SetBool_Response(success=True, message='was asked True')" in text
    refused = ros2("service", "call", "/pause", "std_srvs/srv/Empty", status=1)
    assert "error: the service /pause is of type std_srvs/srv/SetBool, not std_srvs/srv/Empty" in refused


def test_hz_waits_for_a_topic_that_is_not_there_yet(talker):
    process = start("topic", "hz", "/later", "--spin-time", "0.2")
    assert "WARNING: topic [/later] does not appear to be published yet" in process.stderr.readline()
    later = talker.create_publisher(String, "/later", 10)
    timer = talker.create_timer(0.05, lambda: later.publish(String()))
    assert process.stdout.readline().startswith("average rate: ")
    process.terminate()
    process.wait(60)
    talker.destroy_timer(timer)
    talker.destroy_publisher(later)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["topic", "info", "/nothing", "--spin-time", "0.2"], "ros2: error: unknown topic '/nothing'"),
        (["topic", "echo", "/nothing", "--spin-time", "0.2"], "does not appear to be published yet"),
        (["topic", "pub", "/x", "std_msgs/msg/Nothing"], "the type 'std_msgs/msg/Nothing' is unknown"),
        (["topic", "pub", "/x", "std_msgs/msg/String", "{dat: 1}"], "String has no field 'dat': expected one of data"),
        (["topic", "pub", "/x", "std_msgs/msg/String", "{data: 1}"], "1 does not fit field 'data' of type string"),
        (["node", "info", "/nobody", "--spin-time", "0.2"], "unable to find node '/nobody'"),
        (["topic", "pub", "/x", "std_msgs/msg/Nothing", "-r", "nan"], "--rate must be greater than zero, got nan"),
        (["service", "call", "/x", "std_srvs/srv/Nothing", "-r", "0"], "--rate must be greater than zero, got 0.0"),
        (["bag", "play", "/nowhere", "-r", "nan"], "--rate must be greater than zero, got nan"),
        (["bag", "info", "/nowhere"], "no bag at /nowhere"),
        (["bag", "record"], "nothing to record"),
        (["topic", "fly"], "invalid choice: 'fly'"),
        (["launch", "mujoban.launch.py"], "no command 'launch' here, expected one of bag, "),
    ],
)
def test_bad_input_is_one_line_and_has_the_status_of_the_genuine_command(arguments, expected):
    assert expected in ros2(*arguments, status=2 if "choice" in expected or "command" in expected else 1)


def test_records_until_interrupted(talker, tmp_path):
    process = start("bag", "record", "-o", str(tmp_path / "bag"), "/pose", "/episode")
    end = time.monotonic() + 90
    while talker.count < 1 or "Subscribed to topic '/pose'" not in process.stderr.readline():
        assert time.monotonic() < end
    time.sleep(1.0)
    process.send_signal(signal.SIGINT)
    assert process.wait(60) == 0
    bag = open_bag(tmp_path / "bag")
    stamps = [t.stamp for t in bag.ticks([topics.POSE])]
    assert len(stamps) > 20 and set(np.diff(stamps)) == {topics.TICK}
    assert bag.topics["/episode"].count == 1


def test_what_is_recorded_in_simulated_time_begins_with_the_clock(talker, tmp_path):
    process = start("bag", "record", "--use-sim-time", "-o", str(tmp_path / "bag"), "/pose", "/episode")
    assert "waiting for /clock" in process.stderr.readline()
    time.sleep(1.0)
    clock = talker.create_publisher(topics.CLOCK.type, topics.CLOCK.name, topics.CLOCK.qos)
    timer = talker.create_timer(0.02, lambda: clock.publish(conversions.clock_to_msg(1000 * 10**9)))
    while "Subscribed to topic '/pose'" not in process.stderr.readline():
        assert process.poll() is None
    time.sleep(1.0)
    talker.destroy_timer(timer)
    talker.destroy_publisher(clock)
    process.send_signal(signal.SIGINT)
    assert process.wait(60) == 0
    bag = open_bag(tmp_path / "bag")
    assert bag.topics["/pose"].count > 5 and bag.topics["/episode"].count == 1
    assert bag.span == (1000 * 10**9, 1000 * 10**9)


def test_a_signal_that_comes_while_a_message_is_written_leaves_a_whole_bag(talker, tmp_path, monkeypatch):
    add = McapWriter.add_message

    def add_and_be_interrupted(*what):
        add(*what)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(McapWriter, "add_message", add_and_be_interrupted)
    assert run(["bag", "record", "-o", str(tmp_path / "bag"), "/pose"]) == 0
    assert open_bag(tmp_path / "bag").topics["/pose"].count > 0


@pytest.fixture
def bag(tmp_path) -> Path:
    from rclpy.serialization import serialize_message

    with BagWriter(tmp_path / "bag", [topics.POSE, topics.EPISODE]) as writer:
        for tick in range(1, 41):
            message = conversions.pose_to_msg(conversions.header(tick * topics.TICK), (tick, 0.0, 0.0))
            writer.write(topics.POSE.name, tick * topics.TICK, serialize_message(message))
    return tmp_path / "bag"


def test_info_describes_a_bag(bag):
    lines = ros2("bag", "info", str(bag)).splitlines()
    assert lines[1] == "Files:             bag_0.mcap"
    assert lines[4] == "ROS Distro:        jazzy"
    assert lines[5] == "Duration:          1.950s"
    assert lines[8] == "Messages:          40"
    pose = "Topic: /pose | Type: geometry_msgs/msg/PoseStamped | Count: 40 | Serialization Format: cdr"
    assert lines[10] == " " * 19 + pose


def test_info_names_the_distribution_that_recorded_a_bag(tmp_path):
    with Writer(tmp_path / "old", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        writer.add_connection("/chatter", "std_msgs/msg/String", typestore=get_typestore(Stores.ROS2_HUMBLE))
    metadata = tmp_path / "old" / "metadata.yaml"
    text = re.sub(r"ros_distro: .*", "ros_distro: humble", metadata.read_text())
    metadata.write_text(text)
    assert "\nROS Distro:        humble\n" in ros2("bag", "info", str(tmp_path / "old"))
    metadata.write_text(text.replace("ros_distro: humble", ""))
    assert "\nROS Distro:        unknown\n" in ros2("bag", "info", str(tmp_path / "old"))


def test_plays_every_message_to_a_node_that_listens(ros, bag):
    node = ros.create_node("listener")
    heard, clock = [], []
    node.create_subscription(topics.POSE.type, "/replayed", heard.append, topics.POSE.qos)
    node.create_subscription(topics.CLOCK.type, topics.CLOCK.name, clock.append, topics.CLOCK.qos)
    process = start(
        "bag", "play", str(bag), "-r", "4", "-d", "1.5", "--clock", "--topics", "/pose", "-m", "/pose:=/replayed"
    )
    while process.poll() is None:
        ros.spin_once(node, timeout_sec=0.05)
    assert process.returncode == 0, process.stderr.read()
    ros.spin_once(node, timeout_sec=0.2)
    assert [conversions.pose_from_msg(m)[0] for m in heard] == list(range(1, 41))
    times = [conversions.stamp_of(m) for m in clock]
    assert len(times) > 5 and times == sorted(times) and times[-1] <= 40 * topics.TICK


def test_a_damaged_bag_is_described_with_a_warning_and_reindexed(bag):
    file = bag / "bag_0.mcap"
    damaged = file.read_bytes()[:-30]
    file.write_bytes(damaged)
    said = ros2("bag", "play", str(bag), status=1)
    assert "SHA-256 is not the one" in said and "; `ros2 bag reindex BAG` keeps what is whole" in said
    assert "Messages:          40" in ros2("bag", "info", str(bag))
    done = subprocess.run([*COMMAND, "bag", "reindex", bag], capture_output=True, text=True, check=True)
    assert "warning: bag_0.mcap is truncated" in done.stderr
    assert len(list(open_bag(bag).messages())) == 40
    old = bag.with_name("bag.damaged")
    assert (old / file.name).read_bytes() == damaged
    assert find_bags([bag.parent]) == [bag], "nobody learns from both"
    assert f"{old} exists already" in ros2("bag", "reindex", str(bag), status=1)
    bag.rename(bag.with_name("bag.reindexed"))  # as where the command was killed just before its end
    with pytest.raises(BagError, match="no bag in"):
        find_bags([bag.parent])
    ros2("bag", "reindex", str(bag))
    assert find_bags([bag.parent]) == [bag]


def test_services_tell_their_type(talker):
    assert ros2("service", "type", "/pause") == "std_srvs/srv/SetBool\n"
    assert ros2("service", "type", "/nothing", "--spin-time", "0.2", status=1) == ""


def test_interfaces_are_shown_with_those_of_their_fields():
    text = ros2("interface", "show", "mujoban_msgs/msg/Instruction")
    assert "uint8 NORTH=1\n" in text and text.endswith("uint32 sequence\nuint8 direction\n")
    stamp = "\tbuiltin_interfaces/Time stamp\n\t\tint32 sec\n\t\tuint32 nanosec\n"
    assert f"std_msgs/Header header\n{stamp}\tstring frame_id\n" in text
    assert "#" not in ros2("interface", "show", "--no-comments", "mujoban_msgs/msg/Instruction")
    felt = ros2("interface", "show", "mujoban_msgs/msg/Proprioception")
    assert "geometry_msgs/Vector3 angular_velocity\n\tfloat64 x\n" in felt
    assert "mujoban_msgs/msg/Episode" in ros2("interface", "package", "mujoban_msgs").splitlines()
    assert "Could not find the interface 'std_msgs/msg/No'" in ros2("interface", "show", "std_msgs/msg/No", status=1)


def test_bandwidth_is_that_of_the_latest_messages():
    bandwidth = Bandwidth(3)
    for moment, size in ((0.0, 9), (1.0, 1000), (2.0, 2000), (3.0, 3000)):
        bandwidth.add(moment, size)
    expected = "2.00 KB/s from 3 messages\n\tMessage size mean: 2.00 KB min: 1.00 KB max: 3.00 KB"
    assert bandwidth.text(4.0) == expected


def test_long_arrays_are_truncated_unless_asked_for():
    message = conversions.frame_to_msg(conversions.header(1), np.zeros((64, 64, 3), np.uint8))
    assert to_yaml(message).endswith("- 0\n- '...'\n") and to_yaml(message).count("- 0\n") == 128
    assert to_yaml(message, truncate=None).count("- 0\n") == 64 * 64 * 3
    assert "data: '<sequence type: uint8, length: 12288>'" in to_yaml(message, no_arr=True)
    assert "\nk: '<array type: double[9]>'\n" in to_yaml(CameraInfo(), no_arr=True)
    assert "effort: '<sequence type: double, length: 1>'" in to_yaml(JointState(effort=[0.5]), no_arr=True)
    assert "poses: '<sequence type: geometry_msgs/msg/Pose, length: 0>'" in to_yaml(PoseArray(), no_arr=True)
    assert to_csv(conversions.torque_to_msg(conversions.header(1), [0.5, -0.5])).endswith("0.5,-0.5")


def test_fields_are_filled_from_nested_values():
    pose = topics.POSE.type()
    fill(pose, {"header": {"frame_id": "map"}, "pose": {"position": {"x": 3}}}, Time())
    assert (pose.header.frame_id, pose.pose.position.x) == ("map", 3.0)
    torque = topics.TORQUE.type()
    fill(torque, {"effort": [1, 0.5], "name": ["a", "b"]}, Time())
    assert list(torque.effort) == [1.0, 0.5]
    with pytest.raises(CommandError, match="no field 'q'"):
        fill(pose, {"pose": {"q": 1}}, Time())
