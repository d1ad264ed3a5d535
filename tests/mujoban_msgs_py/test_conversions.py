import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from rclpy.serialization import deserialize_message, serialize_message

from mujoban_msgs_py import conversions as c
from mujoban_msgs_py.bags import TypeRegistry
from mujoban_msgs_py.checks import ConversionError
from mujoban_msgs_py.decoders import DECODERS
from mujoban_msgs_py.topics import GRAPH_TOPICS, TOP_CAMERA

HEADER = c.header(7_050_000_000, "map")
TYPES = TypeRegistry()
finite = st.floats(-1e6, 1e6, width=32)
probability = st.floats(0, 1, width=32)


def floats(*shape, elements=finite):
    return hnp.arrays(np.float32, shape, elements=elements)


def over_the_wire(message):
    """Return the message as rclpy delivers it and as a bag's reader deserialises it."""
    data = serialize_message(message)
    type_name = f"{type(message).__module__.split('.')[0]}/msg/{type(message).__name__}"
    return deserialize_message(data, type(message)), TYPES.deserialise(type_name, data)


def assert_round_trip(message, read, expected):
    for received in over_the_wire(message):
        np.testing.assert_array_equal(read(received), expected, strict=True)


@given(st.integers(0, 2**31 * 10**9 - 1))
def test_stamps_round_trip(stamp):
    assert c.stamp_of(c.header(stamp)) == c.stamp_of(c.clock_to_msg(stamp)) == stamp
    assert c.stamp_of(c.pose_to_msg(c.header(stamp), (0, 0, 0))) == stamp


@given(hnp.arrays(np.uint8, (64, 64, 3)))
def test_frames_round_trip(frame):
    assert_round_trip(c.frame_to_msg(HEADER, frame), c.frame_from_msg, frame)


def test_frames_need_not_be_contiguous():
    frame = np.arange(64 * 64 * 3, dtype=np.uint8).reshape(64, 64, 3)[::-1, ::-1]
    assert_round_trip(c.frame_to_msg(HEADER, frame), c.frame_from_msg, frame)


@pytest.mark.parametrize("shape", [(0, 0, 3), (4, 0, 3), (0, 4, 3)])
def test_an_image_without_a_pixel_is_refused_also_where_any_size_will_do(shape):
    message = c.frame_to_msg(HEADER, np.zeros(shape, np.uint8))
    with pytest.raises(ConversionError, match="image must have a pixel or more, got"):
        DECODERS[TOP_CAMERA](message)


def test_frames_with_padded_rows_are_read():
    message = c.frame_to_msg(HEADER, np.zeros((64, 200, 1), np.uint8).reshape(64, 200, 1).repeat(3, 2)[:, :64])
    padded = np.hstack([np.full((64, 192), 9, np.uint8), np.zeros((64, 8), np.uint8)])
    message.step, message.data = 200, padded.tobytes()
    np.testing.assert_array_equal(c.frame_from_msg(message), np.full((64, 64, 3), 9))


@given(floats(20))
def test_proprioception_round_trips(proprio):
    message = c.proprio_to_msg(HEADER, proprio, ["a", "b", "c", "d"])
    assert_round_trip(message, c.proprio_from_msg, proprio)


@given(finite, finite, st.floats(-float(np.float32(math.pi)), float(np.float32(math.pi)), width=32))
def test_poses_round_trip_exactly(x, y, yaw):
    pose = np.array([x, y, yaw], np.float32)
    message = c.pose_to_msg(HEADER, pose)
    # Below 1e-30 the sine of half the angle loses digits that nobody can measure.
    if yaw == 0 or abs(yaw) > 1e-30:
        assert_round_trip(message, c.pose_from_msg, pose)


@given(floats(10, 10, 4, elements=probability))
def test_abstract_states_round_trip(state):
    assert_round_trip(c.abstract_state_to_msg(HEADER, state), c.abstract_state_from_msg, state)


@given(st.integers(0, 2**32 - 1), st.integers(0, 4))
def test_instructions_round_trip(sequence, direction):
    reading = c.InstructionReading(np.int64(sequence), np.int64(direction))
    for received in over_the_wire(c.instruction_to_msg(HEADER, reading)):
        assert c.instruction_from_msg(received) == (sequence, direction)


@given(st.integers(0, 2**32 - 1), probability, st.booleans(), st.booleans())
def test_terminations_round_trip(sequence, p, terminated, timed_out):
    reading = c.TerminationReading(sequence, np.float32(p), np.bool_(terminated), np.bool_(timed_out))
    for received in over_the_wire(c.termination_to_msg(HEADER, reading)):
        assert c.termination_from_msg(received) == (sequence, p, terminated, timed_out)


@given(hnp.arrays(np.float32, st.integers(1, 8), elements=st.floats(-1, 1, width=32)))
def test_torques_round_trip(torque):
    assert_round_trip(c.torque_to_msg(HEADER, torque), c.torque_from_msg, torque)


@given(floats(3), hnp.arrays(np.float32, st.tuples(st.integers(0, 6), st.just(2)), elements=finite))
def test_ground_truth_round_trips(velocity, boxes):
    assert_round_trip(c.twist_to_msg(HEADER, velocity), c.twist_from_msg, velocity)
    assert_round_trip(c.boxes_to_msg(HEADER, boxes), c.boxes_from_msg, boxes)


def test_camera_calibration_round_trips():
    intrinsics = np.array([[38.0, 0, 31.5], [0, 38.0, 31.5], [0, 0, 1]])
    assert_round_trip(c.camera_info_to_msg(HEADER, intrinsics), c.camera_info_from_msg, intrinsics)


def test_episodes_round_trip():
    reading = c.EpisodeTruthReading(3, -5, 4, "#####\n#@$.#", 17, 0.5, -1.25, True, True, False, 2)
    numpy_scalars = reading._replace(seed=np.int64(-5), reward=np.float32(0.5), solved=np.bool_(True))
    for received in over_the_wire(c.episode_truth_to_msg(HEADER, numpy_scalars)):
        assert c.episode_truth_from_msg(received) == reading
    public = c.EpisodeReading(3, 17, True)
    for received in over_the_wire(c.episode_to_msg(HEADER, public)):
        assert c.episode_from_msg(received) == public


def image(**changes):
    message = c.frame_to_msg(HEADER, np.zeros((64, 64, 3), np.uint8))
    for name, value in changes.items():
        setattr(message, name, value)
    return message


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        (image(encoding="bgr8"), "encoding must be 'rgb8', got 'bgr8'"),
        (image(width=32), "must be 64x64 pixels, got 32x64"),
        (image(data=b"123"), "must have 12288 bytes .* got 3"),
        (image(step=1), "at least 192 to the row"),
    ],
)
def test_wrong_images_are_named(message, expected):
    with pytest.raises(ConversionError, match=expected):
        c.frame_from_msg(message)


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda: c.frame_to_msg(HEADER, np.zeros((64, 64, 3))), r"must be uint8 \[H, W, 3\], got float64"),
        (lambda: c.torque_to_msg(HEADER, [math.nan, 0]), "torque must be finite"),
        (lambda: c.torque_to_msg(HEADER, [1.5, 0]), r"torque must lie in \[-1, 1\]"),
        (lambda: c.torque_to_msg(HEADER, [[0.5]]), r"shape \[any\], got \[1, 1\]"),
        (lambda: c.pose_to_msg(HEADER, [0, 0]), r"pose must have shape \[3\], got \[2\]"),
        (lambda: c.pose_to_msg(HEADER, [0, 0, math.inf]), "pose must be finite"),
        (lambda: c.proprio_to_msg(HEADER, np.zeros(13), ["a"]), r"shape \[14\], got \[13\]"),
        (lambda: c.abstract_state_to_msg(HEADER, np.zeros((10, 10, 3))), r"rows, columns, 4\], got \[10, 10, 3\]"),
        (lambda: c.abstract_state_to_msg(HEADER, np.full((10, 10, 4), np.nan)), "probabilities in"),
        (lambda: c.abstract_state_from_msg(c.abstract_state_to_msg(HEADER, np.zeros((7, 7, 4)))), "10x10 cells"),
        (lambda: c.instruction_value(1, 5), r"direction must be one of 0 \(STAY\).* got 5"),
        (lambda: c.instruction_to_msg(HEADER, c.InstructionReading(1, 5)), "direction must be one of"),
        (lambda: c.termination_value(1, math.nan, terminated=True), "probability must lie in"),
        (lambda: c.termination_to_msg(HEADER, c.TerminationReading(1, 2.0, True, False)), "probability must lie in"),
        (lambda: c.boxes_to_msg(HEADER, [[0, math.nan]]), "box positions must be finite"),
    ],
)
def test_what_is_not_a_topics_content_never_becomes_a_message(make, expected):
    with pytest.raises(ConversionError, match=expected):
        make()


def test_a_pose_without_orientation_is_refused():
    message = c.pose_to_msg(HEADER, (0, 0, 0))
    message.pose.orientation.w = 0.0
    with pytest.raises(ConversionError, match="unit quaternion"):
        c.pose_from_msg(message)


def test_a_layer_of_the_wrong_size_is_named():
    message = c.abstract_state_to_msg(HEADER, np.zeros((10, 10, 4)))
    message.box = message.box[:99]
    with pytest.raises(ConversionError, match="layer 'box' of 10x10 cells must have 100, got 99"):
        c.abstract_state_from_msg(message)


def test_every_topic_of_the_graph_can_be_described():
    for topic in GRAPH_TOPICS.values():
        assert TYPES.fields(topic.type_name)
