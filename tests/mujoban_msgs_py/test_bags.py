import os
import signal
import subprocess
import sys
import textwrap
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rclpy.serialization import serialize_message
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from mujoban_msgs_py import conversions, topics
from mujoban_msgs_py.bags import BagError, BagWriter, open_bag, recover_bag
from mujoban_msgs_py.topics import TICK

WANTED = [topics.CAMERA, topics.POSE, topics.INSTRUCTION]


def frame(tick):
    return np.random.default_rng(tick).integers(0, 256, (64, 64, 3), dtype=np.uint8)


@cache
def messages_of(tick):
    """Return (topic name, CDR) of one tick; cached since padding within CDR is arbitrary."""
    header = conversions.header(tick * TICK, "map")
    said = {
        topics.CAMERA: conversions.frame_to_msg(header, frame(tick)),
        topics.POSE: conversions.pose_to_msg(header, (tick, 0.5, 0.25)),
        topics.INSTRUCTION: conversions.instruction_to_msg(header, conversions.InstructionReading(tick, tick % 5)),
    }
    return [(topic.name, serialize_message(message)) for topic, message in said.items()]


def write_bag(path, ticks=40, **options):
    with BagWriter(path, WANTED, **options) as bag:
        for tick in range(1, ticks + 1):
            for name, data in messages_of(tick):
                bag.write(name, tick * TICK, data)
            if tick % 10 == 0:
                bag.end_episode()
    return Path(path)


@pytest.mark.parametrize("compression", ["zstd", "lz4", ""])
def test_a_bag_gives_back_what_was_written(tmp_path, compression):
    bag = open_bag(write_bag(tmp_path / "bag", compression=compression))
    written = [(name, tick * TICK, data) for tick in range(1, 41) for name, data in messages_of(tick)]
    assert [(m.topic, m.stamp, m.data) for m in bag.messages()] == written
    assert {name: info.count for name, info in bag.topics.items()} == {t.name: 40 for t in WANTED}
    assert bag.span == (TICK, 40 * TICK)


def test_a_bag_carries_the_quality_of_service_of_the_graph(tmp_path):
    bag = open_bag(write_bag(tmp_path / "bag", ticks=1))
    said = {topic: bag.topics[topic.name].qos[0] for topic in WANTED}
    assert {t: (q["depth"], q["durability"] == "transient_local") for t, q in said.items()} == {
        topic: (topic.qos.depth, topic.latched) for topic in WANTED
    }


def test_values_are_numpy_and_topics_can_be_chosen(tmp_path):
    bag = open_bag(write_bag(tmp_path / "bag"))
    values = list(bag.read([topics.POSE.name]))
    assert len(values) == 40
    np.testing.assert_array_equal(values[2].value, np.float32([3, 0.5, 0.25]))


def test_ticks_join_topics_by_stamp(tmp_path):
    bag = open_bag(write_bag(tmp_path / "bag", chunk_size=50_000))
    ticks = list(bag.ticks([topics.INSTRUCTION, topics.CAMERA]))
    assert [t.stamp for t in ticks] == [n * TICK for n in range(1, 41)]
    instruction, picture = ticks[6].values
    assert instruction == (7, 2)
    np.testing.assert_array_equal(picture, frame(7))


def test_an_incomplete_tick_is_left_out_and_counted(tmp_path):
    with BagWriter(tmp_path / "bag", WANTED) as writer:
        for tick in (1, 2, 3):
            for name, data in messages_of(tick):
                if (tick, name) != (2, topics.POSE.name):
                    writer.write(name, tick * TICK, data)
    bag = open_bag(tmp_path / "bag")
    assert [t.stamp for t in bag.ticks([topics.CAMERA, topics.POSE])] == [TICK, 3 * TICK]
    assert bag.incomplete == {topics.CAMERA.name: 1}


def test_files_are_split_by_episodes(tmp_path):
    path = write_bag(tmp_path / "bag", episodes_per_file=2)
    assert [f.name for f in open_bag(path).files] == ["bag_0.mcap", "bag_1.mcap"]
    assert next(open_bag(path / "bag_1.mcap").messages([topics.POSE.name])).stamp == 21 * TICK


def test_any_reader_of_ros_bags_reads_it(tmp_path):
    path = write_bag(tmp_path / "bag", episodes_per_file=2)
    with Reader(path) as reader:
        assert reader.message_count == 120
        stamps = [stamp for _, stamp, _ in reader.messages()]
        assert stamps[0] == TICK and stamps[-1] == 40 * TICK
        assert {c.msgtype for c in reader.connections} == {t.type_name for t in WANTED}
    with (path / "bag_0.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        decoded = list(reader.iter_decoded_messages(topics=[topics.INSTRUCTION.name]))
    assert [m.decoded_message.direction for m in decoded[:3]] == [1, 2, 3]
    assert decoded[0].message.log_time == TICK


def test_sqlite_bags_are_read_alike(tmp_path):
    store = get_typestore(Stores.ROS2_JAZZY)
    with Writer(tmp_path / "old", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection(topics.POSE.name, topics.POSE.type_name, typestore=store)
        for tick in (1, 2):
            data = dict(messages_of(tick))[topics.POSE.name]
            writer.write(connection, tick * TICK, data)
    (tmp_path / "old" / "metadata.yaml").rename(tmp_path / "metadata.yaml")
    for _ in range(2):
        bag = open_bag(tmp_path / "old")
        assert [v.value[0] for v in bag.read()] == [1, 2]
        assert bag.topics[topics.POSE.name].count == 2
        if (tmp_path / "metadata.yaml").exists():
            (tmp_path / "metadata.yaml").rename(tmp_path / "old" / "metadata.yaml")


KILLED = """
import os, signal, sys
from tests_bags import messages_of, WANTED
from mujoban_msgs_py.bags import BagWriter
from mujoban_msgs_py.topics import TICK
bag = BagWriter(sys.argv[1], WANTED, chunk_size=30_000)
for tick in range(1, 51):
    for name, data in messages_of(tick):
        bag.write(name, tick * TICK, data)
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.fixture
def killed_bag(tmp_path):
    """A bag of 50 ticks whose writer was killed without a chance to finish."""
    (tmp_path / "tests_bags.py").write_text(Path(__file__).read_text())
    (tmp_path / "killed.py").write_text(textwrap.dedent(KILLED))
    command = [sys.executable, tmp_path / "killed.py", tmp_path / "killed"]
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    assert subprocess.run(command, env=environment, check=False).returncode == -signal.SIGKILL
    return tmp_path / "killed"


def test_a_killed_writer_leaves_all_whole_chunks(killed_bag):
    with pytest.raises(BagError, match=r"killed_0\.mcap is truncated"):
        open_bag(killed_bag)
    bag = open_bag(killed_bag, damaged="skip")
    ticks = list(bag.ticks(WANTED))
    # A chunk holds two to three ticks, so that only the last ones may be missing.
    assert 47 <= len(ticks) <= 50
    np.testing.assert_array_equal(ticks[40].values[0], frame(41))
    assert "truncated" in bag.skipped[0]


def test_a_killed_bag_can_be_recovered_for_every_reader(killed_bag, tmp_path):
    assert recover_bag(killed_bag, tmp_path / "whole")
    with Reader(tmp_path / "whole") as reader:
        assert reader.message_count >= 47 * 3
    assert len(list(open_bag(tmp_path / "whole").ticks(WANTED))) >= 47


def test_a_bag_without_metadata_is_read_from_its_files(tmp_path):
    path = write_bag(tmp_path / "bag", ticks=120, episodes_per_file=1)
    (path / "metadata.yaml").unlink()
    assert [m.stamp for m in open_bag(path).messages([topics.POSE.name])] == [n * TICK for n in range(1, 121)]


def damage(path, position):
    data = bytearray(path.read_bytes())
    data[position] ^= 0xFF
    path.write_bytes(data)


@pytest.mark.parametrize("compression", ["zstd", ""])
def test_damage_to_a_chunk_is_noticed_and_can_be_skipped(tmp_path, compression):
    path = write_bag(tmp_path / "bag", chunk_size=30_000, compression=compression)
    file = path / "bag_0.mcap"
    damage(file, file.stat().st_size // 2)
    with pytest.raises(BagError, match=r"bag_0\.mcap .*damaged.*; `ros2 bag reindex BAG` keeps what is whole$"):
        list(open_bag(path).messages())
    bag = open_bag(path, damaged="skip")
    stamps = [t.stamp // TICK for t in bag.ticks(WANTED)]
    assert stamps[0] == 1 and stamps[-1] == 40 and 36 <= len(stamps) < 40
    assert any("damaged chunk" in text for text in bag.skipped)


def test_damage_to_the_first_chunk_does_not_hide_the_others(tmp_path):
    path = write_bag(tmp_path / "bag", chunk_size=30_000, compression="")
    damage(path / "bag_0.mcap", 20_000)
    assert len(list(open_bag(path, damaged="skip").ticks(WANTED))) >= 37


@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.9, 0.99])
def test_a_truncated_file_is_refused_by_name(tmp_path, share):
    path = write_bag(tmp_path / "bag", chunk_size=30_000)
    file = path / "bag_0.mcap"
    os.truncate(file, int(file.stat().st_size * share))
    with pytest.raises(BagError, match=r"bag_0\.mcap"):
        list(open_bag(path).messages())
    stamps = [m.stamp for m in open_bag(path, damaged="skip").messages()]
    assert stamps == sorted(stamps) and len(stamps) <= 120 * share + 9


def test_a_missing_topic_is_named_with_those_that_are_there(tmp_path):
    bag = open_bag(write_bag(tmp_path / "bag", ticks=2))
    with pytest.raises(BagError, match=r"no topic /nothing in bag .*bag; its topics: /camera/image_raw, /inst"):
        list(bag.messages(["/nothing"]))


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda p: None, "no bag at"),
        (lambda p: p.mkdir(), "is not a bag"),
        (lambda p: p.write_text("hello"), "expected a folder, .mcap or .db3"),
        (lambda p: (p.mkdir(), (p / "metadata.yaml").write_text("a: [")), "is not the metadata"),
        (lambda p: (write_bag(p, 2), (p / "b_0.mcap").unlink()), "cannot read .*b_0.mcap"),
        (lambda p: (write_bag(p, 2), (p / "b_0.mcap").write_bytes(b"PK" * 99)), "b_0.mcap is damaged or another file"),
    ],
)
def test_what_is_no_bag_is_refused_by_name(tmp_path, make, expected):
    make(tmp_path / "b")
    with pytest.raises(BagError, match=expected):
        open_bag(tmp_path / "b")


def test_a_message_that_does_not_fit_its_topic_is_named(tmp_path):
    with BagWriter(tmp_path / "bag", [topics.CAMERA, topics.POSE]) as bag:
        bag.write(
            topics.CAMERA.name, 5, serialize_message(conversions.frame_to_msg(conversions.header(5), frame(1)[:9]))
        )
        bag.write(topics.POSE.name, 6, b"\0\1\0\0")
    with pytest.raises(BagError, match=r"topic /camera/image_raw at 5 ns: image must be 64x64"):
        list(open_bag(tmp_path / "bag").read([topics.CAMERA.name]))
    with pytest.raises(BagError, match=r"topic /pose: 4 bytes are not a serialised geometry_msgs/msg/PoseStamped"):
        list(open_bag(tmp_path / "bag").read([topics.POSE.name]))


def test_a_bag_never_overwrites(tmp_path):
    write_bag(tmp_path / "bag", ticks=1)
    with pytest.raises(BagError, match="exists already"):
        BagWriter(tmp_path / "bag")


def test_writing_to_an_unknown_topic_or_a_closed_bag_is_refused(tmp_path):
    bag = BagWriter(tmp_path / "bag", WANTED)
    with pytest.raises(BagError, match="has no topic '/nothing'"):
        bag.write("/nothing", 0, b"")
    with pytest.raises(BagError, match="unknown: expected a type of Jazzy"):
        bag.add_topic("/new", "nobody_msgs/msg/Nothing")
    bag.close()
    with pytest.raises(BagError, match="is closed"):
        bag.write(topics.POSE.name, 0, b"")
