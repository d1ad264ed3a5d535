"""Damaged, foreign, doubled and missing files: each is named, and none is read as if nothing had happened."""

import os
import shutil
import sqlite3
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import yaml
import zstandard
from mcap.writer import Writer as McapWriter
from rclpy.serialization import serialize_message
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from mujoban_msgs_py import conversions, topics
from mujoban_msgs_py.bags import BagError, BagWriter, open_bag, recover_bag
from mujoban_msgs_py.topics import TICK


def pose(tick):
    return serialize_message(conversions.pose_to_msg(conversions.header(tick * TICK), (tick, 0.5, 0.25)))


ABOUT = {"body": "ant", "world": "reference"}


def write_bag(path, ticks=30, first=1):
    """Write a bag of three files."""
    with BagWriter(path, [topics.POSE], episodes_per_file=1, chunk_size=500, flush_after=4, about=ABOUT) as bag:
        for tick in range(first, first + ticks):
            bag.write(topics.POSE.name, tick * TICK, pose(tick))
            if tick % 10 == 0:
                bag.end_episode()
    return Path(path)


@pytest.fixture
def bag(tmp_path):
    return write_bag(tmp_path / "bag")


@pytest.fixture
def other(tmp_path):
    return write_bag(tmp_path / "other" / "bag", first=101)


def read(path, **options):
    bag = open_bag(path, **options)
    return [value.value[0] for value in bag.read()]


def edit(bag, change):
    """Change what metadata.yaml says, as somebody who knows how it is made."""
    path = bag / "metadata.yaml"
    content = yaml.safe_load(path.read_text())
    information = content["rosbag2_bagfile_information"]
    information["custom_data"].pop("mujoban_metadata_sha256")
    change(information)
    path.write_text(yaml.safe_dump(content, sort_keys=False))


def replace(bag, other):
    shutil.copy(other / "bag_1.mcap", bag / "bag_1.mcap")


def swap(bag, other):
    shutil.copy(bag / "bag_0.mcap", bag / "bag_1.mcap")


def list_twice(bag, other):
    edit(bag, lambda i: i["relative_file_paths"].append("bag_0.mcap"))


def unlist(bag, other):
    edit(bag, lambda i: i["relative_file_paths"].pop())


def list_nothing(bag, other):
    edit(bag, lambda i: i.update(relative_file_paths=[], files=[]))


def lose_the_last_with_the_metadata(bag, other):
    (bag / "metadata.yaml").unlink()
    (bag / "bag_2.mcap").unlink()


def lose_one_with_the_metadata(bag, other):
    (bag / "metadata.yaml").unlink()
    (bag / "bag_1.mcap").unlink()


def mix_without_metadata(bag, other):
    (bag / "metadata.yaml").unlink()
    replace(bag, other)


def make_a_pipe(bag, other):
    (bag / "bag_1.mcap").unlink()
    os.mkfifo(bag / "bag_1.mcap")


def flip_a_bit(bag, other):
    data = bytearray((bag / "bag_1.mcap").read_bytes())
    data[len(data) // 2] ^= 4
    (bag / "bag_1.mcap").write_bytes(data)


def say_other_counts(bag, other):
    edit(bag, lambda i: (i["files"][0].update(message_count=9), i["custom_data"].clear()))


def say_other_times(bag, other):
    edit(bag, lambda i: (i["files"][0]["starting_time"].update(nanoseconds_since_epoch=1), i["custom_data"].clear()))


@pytest.mark.parametrize(
    ("damage", "named"),
    [
        (replace, "bag_1.mcap is of another bag"),
        (swap, "bag_1.mcap is damaged or another file"),
        (list_twice, "lists bag_0.mcap twice"),
        (unlist, "bag_2.mcap is not listed"),
        (list_nothing, "lists no file"),
        (lose_one_with_the_metadata, "lacks file number 1"),
        (lose_the_last_with_the_metadata, "files may be missing"),
        (mix_without_metadata, "bag_1.mcap is of another bag"),
        (make_a_pipe, "bag_1.mcap: it is not a regular file"),
        (flip_a_bit, "bag_1.mcap is damaged"),
        (say_other_counts, "has 10 messages, not 9"),
        (say_other_times, r"bag_0.mcap reaches from"),
    ],
)
def test_damage_is_named(bag, other, damage, named):
    assert read(bag) == list(range(1, 31))
    damage(bag, other)
    with pytest.raises(BagError, match=named):
        read(bag)


@pytest.mark.parametrize("damage", [replace, list_twice, unlist, mix_without_metadata])
def test_where_damage_is_skipped_foreign_and_double_messages_are_left_out_and_named(bag, other, damage):
    damage(bag, other)
    opened = open_bag(bag, damaged="skip")
    found = [value.value[0] for value in opened.read()]
    assert (found == sorted(set(found)) and set(found) < {*range(1, 31)}) or found == list(range(1, 31))
    assert opened.skipped


def foreign(path, channel):
    """Write a file of another writer, with a channel of whatever kind beside one that is as it should be."""
    with path.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start()
        text = b"\xff" if channel == "schema" else b"string data"
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", text)
        sound = writer.register_channel("/sound", "cdr", schema)
        metadata = {"qos": {"offered_qos_profiles": "{"}, "list": {"offered_qos_profiles": "3"}}.get(channel, {})
        other = writer.register_channel("/other", "json", 0 if channel == "json" else schema, metadata)
        for topic in (sound, other):
            writer.add_message(topic, 5, b"{}", 5)
        writer.finish()
    return path


@pytest.mark.parametrize(
    ("channel", "named"), [("qos", "QoS profiles of /other"), ("list", "QoS"), ("schema", "no text")]
)
def test_what_another_writer_got_wrong_is_named_and_can_be_skipped(tmp_path, channel, named):
    path = foreign(tmp_path / "other.mcap", channel)
    with pytest.raises(BagError, match=rf"other\.mcap .*{named}"):
        open_bag(path).topics  # noqa: B018
    bag = open_bag(path, damaged="skip")
    assert set(bag.topics) == {"/sound", "/other"}


def test_a_channel_without_a_schema_is_left_out(tmp_path):
    bag = open_bag(foreign(tmp_path / "other.mcap", "json"))
    assert set(bag.topics) == {"/sound"} and [m.topic for m in bag.messages()] == ["/sound"]


def test_no_flipped_bit_of_a_bag_is_read_over(bag, tmp_path):
    rng, silent = np.random.default_rng(0), []
    names = ["metadata.yaml", "bag_0.mcap", "bag_2.mcap"]
    for trial in range(90):
        copy = shutil.copytree(bag, tmp_path / f"copy{trial}")
        file = copy / names[trial % len(names)]
        data = bytearray(file.read_bytes())
        data[rng.integers(len(data))] ^= 1 << rng.integers(8)
        file.write_bytes(data)
        try:
            silent.append((file.name, read(copy)))
        except BagError as error:
            assert "\n" not in str(error) and str(copy) in str(error)
    # A flip in the form of the YAML text, such as that of quotes, changes nothing that it says.
    assert all(name == "metadata.yaml" and found == list(range(1, 31)) for name, found in silent), silent
    assert len(silent) < 10


@pytest.mark.parametrize(
    "text", ["", "a: [", "\x00\xff", "- 1", "rosbag2_bagfile_information: 5", "rosbag2_bagfile_information: {}",
             "rosbag2_bagfile_information: {topics_with_message_count: [{topic_metadata: 3}]}", "? " * 3000,
             "2024-99-99"],
)  # fmt: skip
def test_damaged_metadata_is_one_error(bag, text):
    (bag / "metadata.yaml").write_text(text, encoding="latin-1")
    with pytest.raises(BagError, match="is not the metadata of a rosbag2 bag"):
        open_bag(bag)


def test_whatever_is_left_of_a_bag_names_what_was_recorded(bag, tmp_path):
    assert open_bag(bag).about == ABOUT
    recover_bag(bag, tmp_path / "whole")
    assert open_bag(tmp_path / "whole").about == ABOUT
    assert open_bag(bag / "bag_1.mcap").about == ABOUT
    (bag / "metadata.yaml").unlink()
    assert open_bag(bag).about == ABOUT
    (bag / "bag_2.mcap").unlink()
    assert open_bag(bag, damaged="skip").about == ABOUT


@pytest.fixture
def sqlite_bag(tmp_path):
    with Writer(tmp_path / "sqlite", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        store = get_typestore(Stores.ROS2_JAZZY)
        connection = writer.add_connection(topics.POSE.name, topics.POSE.type_name, typestore=store)
        for tick in range(1, 31):
            writer.write(connection, tick * TICK, pose(tick))
    return tmp_path / "sqlite"


def test_a_bag_without_checksums_says_so_and_gets_them_by_being_recovered(sqlite_bag, tmp_path):
    with pytest.warns(UserWarning, match="carries no checksums.*reindex"):
        assert read(sqlite_bag) == list(range(1, 31))
    with pytest.warns(UserWarning):
        assert recover_bag(sqlite_bag, tmp_path / "whole") == []
    assert read(tmp_path / "whole") == list(range(1, 31))


@pytest.mark.filterwarnings("ignore:.*no checksums")
def test_a_sqlite_bag_that_lost_messages_or_its_structure_is_named(sqlite_bag, tmp_path):
    (file,) = sqlite_bag.glob("*.db3")
    broken = shutil.copytree(sqlite_bag, tmp_path / "broken")
    with (broken / file.name).open("r+b") as stream:
        stream.seek(4096)
        stream.write(os.urandom(4096))
    with pytest.raises(BagError, match=r"db3 is damaged"):
        read(broken)
    with sqlite3.connect(file) as database:
        database.execute("DELETE FROM messages WHERE id > 20")
    with pytest.raises(BagError, match="has 20 messages, not 30"):
        read(sqlite_bag)


def test_a_decompression_bomb_takes_no_memory(tmp_path):
    bomb = zstandard.compress(bytes(1 << 29), 19)
    assert len(bomb) < 100_000
    path = tmp_path / "bomb.mcap"
    with path.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start("ros2")
        chunk = struct.pack("<QQQII", 0, 0, 1 << 29, 0, 4) + b"zstd" + struct.pack("<Q", len(bomb)) + bomb
        stream.write(b"\x06" + struct.pack("<Q", len(chunk)) + chunk)
        writer.finish()
    tracemalloc.start()
    with pytest.raises(BagError, match=r"bomb\.mcap .*damaged chunk.*536870912 bytes, expected at most"):
        list(open_bag(path).messages())
    assert tracemalloc.get_traced_memory()[1] < 50 << 20
    tracemalloc.stop()


def test_a_killed_writer_has_lost_ten_ticks_at_most(tmp_path):
    writer = BagWriter(tmp_path / "bag", [topics.POSE], flush_after=8)
    for tick in range(1, 101):
        writer.write(topics.POSE.name, tick * TICK, pose(tick))
        # What is in the file now is what is left of it, should the process be killed here.
        shutil.copy(tmp_path / "bag" / "bag_0.mcap", tmp_path / "left.mcap")
        left = [m.stamp for m in open_bag(tmp_path / "left.mcap", damaged="skip").messages()]
        assert tick * TICK - (left[-1] if left else 0) <= 10 * TICK
    writer.close()
