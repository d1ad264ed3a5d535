from functools import partial

import numpy as np
import pytest
from PIL import Image

from bringup.picture import main
from mujoban_core.program import exit_status


def test_the_picture_shows_the_world_from_above_and_four_views_of_the_robot(tmp_path):
    path = tmp_path / "new" / "world.png"
    main([str(path), "--seed", "1", "--difficulty", "1", "--steps", "8"])
    with Image.open(path) as picture:
        pixels = np.asarray(picture.convert("RGB"))
    height, width, _ = pixels.shape
    assert width == 2 * height + 8
    # Every quarter of the right half is filled, up to the white gap.
    quarters = [half for side in np.array_split(pixels[:, -height:], 2) for half in np.array_split(side, 2, axis=1)]
    assert all((quarter != 255).any(axis=-1).mean() > 0.9 for quarter in quarters)


@pytest.mark.parametrize("argument", [["--seed", "-1"], ["--difficulty", "9"], ["--steps", "1"]])
def test_a_bad_argument_is_named_in_one_line(tmp_path, capsys, argument):
    assert exit_status("picture", partial(main, [str(tmp_path / "world.png"), *argument])) == 2
    message = capsys.readouterr().err.strip()
    assert argument[0].strip("-") in message
    assert argument[1] in message
    assert "\n" not in message
