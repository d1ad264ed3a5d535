import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mujoban_core.grid import AGENT, BOX, GRID_SIZE, TARGET, WALL
from mujoban_sokoban.generator import generate_level
from mujoban_sokoban.levels import Level, LevelError, read_levels, stack_levels, write_levels

BOXOBAN = """\
; 0
##########
##########
##########
#######  #
######## #
#   ###.@#
#   $ $$ #
#. #.$   #
#     . ##
##########

; 1
##########
#*@ ######
#. $######
##########
##########
##########
##########
##########
##########
##########
"""


@st.composite
def level_texts(draw):
    """Closed grids of up to 10 x 10 with as many boxes as targets, some of them on each other."""
    height, width = draw(st.integers(3, GRID_SIZE)), draw(st.integers(4, GRID_SIZE))
    inner = [(r, c) for r in range(1, height - 1) for c in range(1, width - 1)]
    walls = set(draw(st.lists(st.sampled_from(inner), max_size=len(inner) - 2)))
    free = [cell for cell in inner if cell not in walls]
    order = draw(st.permutations(free))
    count = draw(st.integers(1, len(free) - 1))
    boxes, player = set(order[:count]), order[count]
    targets = set(draw(st.permutations(free))[:count])
    rows = [["#"] * width for _ in range(height)]
    for cell in free:
        symbols = "*." if cell in targets else "$ "
        rows[cell[0]][cell[1]] = symbols[0] if cell in boxes else symbols[1]
    rows[player[0]][player[1]] = "+" if player in targets else "@"
    return "\n".join("".join(row) for row in rows)


@given(level_texts())
@settings(max_examples=150)
def test_a_level_survives_the_round_trip_through_text(text):
    level = Level.from_text(text)
    again = Level.from_text(level.to_text())
    assert again == level
    assert again.to_text() == level.to_text()


@given(level_texts())
@settings(max_examples=50)
def test_text_and_abstract_state_show_the_same_things(text):
    state = Level.from_text(text).abstract_state()
    assert state.shape == (GRID_SIZE, GRID_SIZE, 4)
    assert state[..., AGENT].sum() == 1
    assert state[..., BOX].sum() == text.count("$") + text.count("*")
    assert state[..., TARGET].sum() == text.count(".") + text.count("*") + text.count("+")
    assert not (state[..., WALL] * state[..., 1:].max(-1)).any()


def test_smaller_grids_are_centred():
    level = Level.from_text("#####\n#@$.#\n#####")
    assert level.player == (4, 3)
    assert level.boxes.tolist() == [[4, 4]]
    assert level.target[4, 5]


def test_floor_outside_the_walls_becomes_wall():
    level = Level.from_text("  #####\n###@$.#\n#     #\n#######")
    assert level.wall[3, 1]
    assert level.wall[0, 0]


def test_a_file_survives_the_round_trip(tmp_path: Path):
    path = tmp_path / "levels.txt"
    path.write_text(BOXOBAN)
    levels = read_levels(path)
    assert [level.name for level in levels] == ["0", "1"]
    write_levels(path, levels)
    assert re.sub(r" \[level . of 2, sha256 [0-9a-f]{16}\]", "", path.read_text()) == BOXOBAN
    assert read_levels(path) == levels and [level.name for level in read_levels(path)] == ["0", "1"]


def test_generated_levels_can_be_written_and_read(tmp_path: Path):
    levels = [generate_level(difficulty, 5) for difficulty in range(1, 6)]
    write_levels(tmp_path / "levels.txt", levels)
    assert read_levels(tmp_path / "levels.txt") == levels


def test_no_damage_to_a_file_that_was_written_here_yields_other_levels(tmp_path: Path):
    path = tmp_path / "levels.txt"
    levels = [generate_level(difficulty, 5) for difficulty in (1, 3)]
    write_levels(path, levels)
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    flipped = [whole[:i] + bytes([whole[i] ^ 1 << rng.integers(8)]) + whole[i + 1 :] for i in range(len(whole))]
    half = whole.index(b"\n\n") + 1
    swapped = [whole[half + 1 :] + b"\n" + whole[:half], whole[:half], whole[half:], whole + b"\n" + whole]
    for damaged in (*flipped, *swapped, *(whole[:i] for i in range(0, len(whole), 7))):
        path.write_bytes(damaged)
        try:
            assert read_levels(path) == levels
        except LevelError as error:
            assert "levels.txt" in str(error)


def test_windows_line_ends_and_stripped_spaces_are_read(tmp_path: Path):
    path = tmp_path / "levels.txt"
    path.write_bytes(b"\xef\xbb\xbf; first\r\n #####\r\n##@$.#\r\n#    #\r\n######\r\n\r\n####\r\n#@*#\r\n####")
    assert [(level.name, len(level.boxes)) for level in read_levels(path)] == [("first", 1), ("", 1)]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("####\n# $.#\n####", "player"),
        ("######\n#@@$.#\n######", "2 players: expected exactly one"),
        ("######\n#@$$.#\n######", "2 boxes and 1 targets"),
        ("####\n#@ #\n####", "no boxes"),
        ("#####\n#@$. \n#####", "open boundary"),
        ("### #\n#@$.#\n#####", "open boundary"),
        ("#####\n#@$*#\n##  #\n### #", "targets"),
        ("#" * 11 + "\n#@$.      #\n" + "#" * 11, "at most 10"),
        ("\n".join(["#####", "#@$.#", *["#   #"] * 8, "#####"]), "at most 10"),
        ("#####\n#@x.#\n#####", "unknown symbol 'x'"),
    ],
)
def test_a_malformed_level_is_named_with_what_was_expected(tmp_path: Path, text: str, expected: str):
    path = tmp_path / "bad.txt"
    path.write_text(f"; 7\n#####\n#@$.#\n#####\n\n; 8\n{text}\n")
    with pytest.raises(LevelError, match="expected") as error:
        read_levels(path)
    message = str(error.value)
    assert str(path) in message
    assert "level 8" in message
    assert expected in message
    assert "\n" not in message


@pytest.mark.parametrize("content", [b"", b"\n\n \n", b"\x89PNG\xff\xfe\x00"])
def test_a_file_without_levels_is_refused(tmp_path: Path, content: bytes):
    path = tmp_path / "empty.txt"
    path.write_bytes(content)
    with pytest.raises(LevelError, match=r"empty\.txt.*expected"):
        read_levels(path)


def test_a_header_without_rows_is_refused(tmp_path: Path):
    path = tmp_path / "hole.txt"
    path.write_text("; 0\n#####\n#@$.#\n#####\n\n; 1\n\n; 2\n#####\n#@$.#\n#####\n")
    with pytest.raises(LevelError, match="level 1: no rows"):
        read_levels(path)


def test_a_level_cannot_be_changed():
    level = generate_level(1, 0)
    with pytest.raises(ValueError, match="read-only"):
        level.wall[0, 0] = False


def test_a_batch_pads_absent_boxes():
    batch = stack_levels([generate_level(1, 0), generate_level(5, 0)])
    assert batch.boxes.shape == (2, 4, 2)
    assert (batch.boxes[0, 1:] == -1).all()
    assert np.array_equal(batch.boxes[1], generate_level(5, 0).boxes)
