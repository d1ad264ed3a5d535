"""The camera policy: what it sees, what it remembers, what it returns."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from mujoban_controller import camera_weights, evaluate, teacher_weights
from mujoban_controller.controller import Sight, VisuomotorController
from mujoban_controller.evaluate import Options, make_driver
from mujoban_core.bodies import BALL, INERTIAL_SIZE
from mujoban_core.files import digest
from mujoban_core.grid import Instruction
from mujoban_core.interfaces import ControllerInput
from mujoban_rl.networks import rows_of_sky
from mujoban_rl.weights import WeightsError, load_weights, save_weights

SMALL = {"channels": (8, 8, 8), "features": 16, "hidden": 12}


@pytest.fixture
def controller():
    torch.manual_seed(0)
    return VisuomotorController(**SMALL).eval()


def inputs(batch, seed=0):
    rng = np.random.default_rng(seed)
    return ControllerInput(
        instruction=rng.integers(0, 5, batch),
        frame=rng.integers(0, 256, (batch, 64, 64, 3), dtype=np.uint8),
        proprio=rng.normal(size=(batch, BALL.proprio_size)).astype(np.float32),
        terminated=rng.random(batch) < 0.5,
    )


def test_torques_are_limited_and_shaped_like_the_bodys_actuators(controller):
    with torch.no_grad():
        controller.mean.bias.fill_(3.0)
    torque, memory = controller.step(inputs(3), controller.initial_memory(3))
    assert torque.shape == (3, BALL.action_size)
    assert torque.dtype == np.float32
    assert torque.max() == 1.0
    assert [m.shape for m in memory] == [(3, 12), (3, 12), (3, 7)]


def test_the_same_inputs_give_the_same_torques_exactly(controller):
    first, _ = controller.step(inputs(1), controller.initial_memory(1))
    again, _ = controller.step(inputs(1), controller.initial_memory(1))
    assert (first == again).all()


def test_rows_do_not_influence_each_other(controller):
    both = inputs(2)
    alone = ControllerInput(*(a[:1] for a in both[:4]))
    together, _ = controller.step(both, controller.initial_memory(2))
    single, _ = controller.step(alone, controller.initial_memory(1))
    assert together[0] == pytest.approx(single[0], abs=1e-5)


def test_a_sequence_gives_what_its_ticks_give_one_by_one(controller):
    ticks = [inputs(2, seed) for seed in range(5)]
    first = torch.zeros(2, 5, dtype=torch.bool)
    first[1, 3] = True
    memory = controller.initial_memory(2)
    single = []
    for t, tick in enumerate(ticks):
        if t == 3:
            memory = tuple(m.clone() for m in memory)
            for m in memory:
                m[1] = 0.0
        torque, memory = controller.step(tick, memory)
        single.append(torque)
    stacked = [torch.cat(x, 1) for x in zip(*(controller.to_tensors(t) for t in ticks), strict=True)]
    with torch.no_grad():
        output = controller(*stacked, controller.initial_memory(2), first)
    sequence = output.action.mean.clamp(-1, 1).numpy().swapaxes(0, 1)
    assert np.stack(single) == pytest.approx(sequence, abs=1e-5)


def test_the_past_matters(controller):
    blank = controller.initial_memory(1)
    _, memory = controller.step(inputs(1, 1), blank)
    fresh, _ = controller.step(inputs(1, 2), blank)
    later, _ = controller.step(inputs(1, 2), memory)
    assert not np.array_equal(fresh, later)


def test_sky_is_left_out_and_the_floor_is_not(controller):
    x = inputs(1)
    sky, floor = x.frame.copy(), x.frame.copy()
    rows = rows_of_sky(BALL.camera, 8)
    assert 8 <= rows < 32
    sky[:, :rows] = 0
    floor[:, rows:] = 0
    blank = controller.initial_memory(1)
    torque = controller.step(x, blank)[0]
    assert (controller.step(x._replace(frame=sky), blank)[0] == torque).all()
    assert (controller.step(x._replace(frame=floor), blank)[0] != torque).any()


def test_every_instruction_looks_the_same_to_a_robot_that_faces_along_it(controller):
    # Heading is the steer joint; with A's one-hot weights zeroed, only the turned angle tells directions apart.
    steer = INERTIAL_SIZE + BALL.joints.index("steer")
    layer = controller.body_encoder[0]
    joints = len(BALL.joints)
    angles = layer.in_features - 1 - len(Instruction) - 6 - 4 * joints
    with torch.no_grad():
        layer.weight[:, angles : angles + 2 * joints] = 0.0
        layer.weight[:, -1 - len(Instruction) : -1] = 0.0
    x = inputs(4)
    proprio = np.repeat(x.proprio[:1], 4, axis=0)
    # roll's own angle, which is turned as well, must not count
    with torch.no_grad():
        roll = BALL.joints.index("roll")
        layer.weight[:, [angles + 2 * joints + roll, angles + 3 * joints + roll]] = 0.0
    quarter = np.pi / 2
    headings = {Instruction.EAST: 0.0, Instruction.NORTH: quarter, Instruction.WEST: np.pi, Instruction.SOUTH: -quarter}
    proprio[:, steer] = list(headings.values())
    turned = ControllerInput(
        np.array([int(i) for i in headings]), np.repeat(x.frame[:1], 4, axis=0), proprio, np.zeros(4, bool)
    )
    torque, _ = controller.step(turned, controller.initial_memory(4))
    assert torque == pytest.approx(np.repeat(torque[:1], 4, axis=0), abs=1e-5)


def test_dead_reckoning_follows_a_drive_round_a_corner(controller):
    # Two seconds ahead at a cell per second, facing east; then on the spot to the north, then one second ahead.
    ahead = torch.tensor([1.0] * 41 + [0.0] + [1.0] * 21)
    steer = torch.tensor([0.0] * 42 + [np.pi / 2] * 21)
    proprio = torch.zeros(len(ahead), BALL.proprio_size)
    proprio[:, BALL.proprio.planar_velocity][:, 0] = ahead * BALL.cell_size
    proprio[:, INERTIAL_SIZE + BALL.joints.index("steer")] = steer
    track = torch.zeros(1, 7)
    for t in range(len(ahead)):
        track = controller.reckon(proprio[t : t + 1], torch.tensor([t == 41]), track, Sight(None, None))
    since, before, velocity = track[0, :2].tolist(), track[0, 2:4].tolist(), track[0, 4:6].tolist()
    assert since == pytest.approx([0.0, 1.025], abs=1e-4)
    assert before == pytest.approx([2.025, 0.0], abs=1e-4)
    assert velocity == pytest.approx([0.0, 1.0], abs=1e-4)


def test_weights_survive_a_round_trip_and_damage_is_noticed(controller, tmp_path):
    path = tmp_path / "controller.safetensors"
    save_weights(path, controller, controller.config, {})
    loaded = load_weights(VisuomotorController, path)
    blank = controller.initial_memory(1)
    assert (loaded.step(inputs(1), blank)[0] == controller.step(inputs(1), blank)[0]).all()
    path.write_bytes(path.read_bytes()[:-8] + bytes(8))
    with pytest.raises(WeightsError, match="damaged"):
        load_weights(VisuomotorController, path)


def test_unknown_bodies_are_refused():
    with pytest.raises(ValueError, match="unknown body 'car'"):
        VisuomotorController(body="car")


def test_an_evaluation_drives_a_body_with_the_weights_that_ship_for_it():
    _, identity = make_driver(Options(body="ant"))
    assert identity == digest(camera_weights("ant"))


@pytest.mark.parametrize(
    ("driver", "name", "privileged"),
    [
        ("camera", digest(camera_weights("ball")), []),
        ("teacher", f"{digest(teacher_weights('ball'))} (privileged)", ["controller"]),
        ("scripted", "scripted (privileged)", ["controller"]),
    ],
)
def test_the_report_of_an_evaluation_says_which_driver_is_told_the_truth(
    driver, name, privileged, tmp_path, monkeypatch
):
    monkeypatch.setattr(evaluate, "judge", lambda *driven, **levels: {"success_rate": 1.0})
    file = tmp_path / "report.json"
    assert evaluate.main(["--driver", driver, "--episodes", "1", "--json", str(file)]) == 0
    report = json.loads(file.read_text())
    assert report["success_rate"] == 1.0 and report["weights"] == {"controller": name}
    assert report["privileged"] == privileged
