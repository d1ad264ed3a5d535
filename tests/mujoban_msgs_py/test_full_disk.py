"""A disk that is full costs nothing that was written: the bag is finished in room that was held for that."""

import errno

import pytest

from mujoban_msgs_py.bags import BagWriter, open_bag
from mujoban_msgs_py.bags.integrity import HashedFile
from mujoban_msgs_py.topics import POSE, TICK, Topic

BYTES = bytes(1000)


class SmallDisk:
    """A file on a disk with little room besides a reserve, which is room as well once it is given free."""

    def __init__(self, file, reserve, room):
        self._file, self._reserve, self._room = file, reserve, room

    def write(self, data):
        if self._reserve.full is None and (room := self._room[0]) < len(data):
            if room == 0:
                raise OSError(errno.ENOSPC, "No space left on device")
            data = data[:room]
        count = self._file.write(data)
        self._room[0] -= count
        return count

    def __getattr__(self, name):
        return getattr(self._file, name)


@pytest.fixture
def disk(monkeypatch):
    """Return the room of a disk in bytes, in a list."""
    room, make = [40_000], HashedFile.__init__

    def on_small_disk(self, path, reserve):
        make(self, path, reserve)
        self._file = SmallDisk(self._file, reserve, room)

    monkeypatch.setattr(HashedFile, "__init__", on_small_disk)
    return room


@pytest.mark.parametrize("options", [{"flush_after": 3}, {"chunk_size": 5000}, {"episodes_per_file": 2}])
def test_a_bag_is_finished_with_all_that_was_written_and_the_error_names_it(tmp_path, disk, options):
    topic = Topic(POSE.name, POSE.type)
    bag, tick = BagWriter(tmp_path / "the_bag", [topic], compression="", **options), 0
    with pytest.raises(OSError, match=r"No space left on device.*the_bag") as raised, bag:
        for tick in range(1, 1000):
            bag.write(topic.name, tick * TICK, BYTES)
            if tick % 5 == 0:
                bag.end_episode()
    assert raised.value.errno == errno.ENOSPC
    assert disk[0] <= 0 and bag.closed
    stamps = [message.stamp for message in open_bag(tmp_path / "the_bag").messages()]
    assert stamps == [t * TICK for t in range(1, tick + 1)] and tick > 20
