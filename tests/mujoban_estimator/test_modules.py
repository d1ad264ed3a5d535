import numpy as np
import pytest
import torch

from mujoban_core.bodies import ANT, BALL
from mujoban_core.grid import AGENT, BOX, CONTROL_PERIOD, OFFSETS_XY, Instruction
from mujoban_core.interfaces import EstimatorInput, TerminationInput, renew_rows
from mujoban_estimator.bearings import Bearings, follow
from mujoban_estimator.estimator import Belief, StateEstimator
from mujoban_estimator.odometry import FEATURES, Odometry
from mujoban_estimator.termination import ControlTermination
from mujoban_rl.sight.orientation import SIGHT
from mujoban_rl.sight.place import PLACE, phases, phases_along
from mujoban_rl.sight.skyline import HEADINGS, unit
from mujoban_rl.weights import WeightsError, load_weights, save_weights

TICKS = 9


def frames(rng, *shape):
    return rng.integers(0, 256, (*shape, 64, 64, 3), dtype=np.uint8)


def poses(rng, *shape):
    return rng.uniform(-3, 3, (*shape, 3)).astype(np.float32)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture
def estimator():
    torch.manual_seed(0)
    return StateEstimator().eval()


@pytest.fixture
def termination():
    torch.manual_seed(0)
    return ControlTermination().eval()


def run(estimator, frame, pose):
    state = estimator.initial_state(np.zeros(len(frame), np.int64))
    estimates = []
    for t in range(frame.shape[1]):
        estimate, state = estimator.step(EstimatorInput(frame[:, t], pose[:, t]), state)
        estimates.append(estimate)
    return np.stack(estimates, 1), state


def test_estimates_are_probabilities_and_the_agent_is_somewhere(estimator, rng):
    estimate, _ = run(estimator, frames(rng, 2, 1), poses(rng, 2, 1))
    assert estimate.shape == (2, 1, 10, 10, 4) and estimate.dtype == np.float32
    assert (estimate >= 0).all() and (estimate <= 1).all()
    np.testing.assert_allclose(estimate[..., AGENT].sum((-1, -2)), 1.0, atol=1e-5)


def test_stepping_equals_training_on_the_sequence(estimator, rng):
    frame, pose = frames(rng, 2, TICKS), poses(rng, 2, TICKS)
    stepped, _ = run(estimator, frame, pose)
    every = estimator.config.update_every
    with torch.inference_mode():
        features = estimator.encoder(torch.from_numpy(frame[:, ::every].reshape(-1, 64, 64, 3)))
        whole = estimator(features.unflatten(0, (2, -1)), pose[:, ::every], estimator.initial_belief(2))
    expected = torch.sigmoid(whole.logits[..., BOX]).numpy()
    np.testing.assert_allclose(stepped[:, ::every, ..., BOX], expected, atol=1e-4)


def test_estimates_are_held_between_updates(estimator, rng):
    estimate, _ = run(estimator, frames(rng, 1, 5), poses(rng, 1, 5))
    assert (estimate[:, 0] == estimate[:, 3]).all() and (estimate[:, 0] != estimate[:, 4]).any()


def test_rows_do_not_influence_each_other_even_out_of_phase(estimator, rng):
    frame, pose = frames(rng, 2, TICKS), poses(rng, 2, TICKS)
    state = estimator.initial_memory(2)
    for t in range(TICKS):
        if t == 2:
            state = renew_rows(state, estimator.initial_memory(2), np.array([False, True]))
        both, state = estimator.step(EstimatorInput(frame[:, t], pose[:, t]), state)
    alone, _ = run(estimator, frame[1:, 2:], pose[1:, 2:])
    np.testing.assert_allclose(both[1], alone[0, -1], atol=1e-4)


def test_a_step_leaves_the_former_state_alone(estimator, rng):
    state = estimator.initial_memory(1)
    copy = tuple(part.clone() for part in state)
    estimator.step(EstimatorInput(frames(rng, 1), poses(rng, 1)), state)
    assert all(torch.equal(a, b) for a, b in zip(state, copy, strict=True))


def test_seeing_nothing_is_possible_for_all_cells(estimator, rng):
    # From far outside, looking away, no cell is in the frame.
    features = estimator.encoder(torch.from_numpy(frames(rng, 1)))[:, None]
    output = estimator(features, np.array([[[40.0, 0.0, 0.0]]]), estimator.initial_belief(1))
    assert torch.isfinite(output.logits).all()


def test_gradients_flow_through_attention_and_belief(estimator, rng):
    features = estimator.encoder(torch.from_numpy(frames(rng, 4))).unflatten(0, (1, 4))
    output = estimator(features, poses(rng, 1, 4), estimator.initial_belief(1))
    output.logits[:, -1].sum().backward()
    for parameter in (estimator.attention.log_width, estimator.memory.from_hidden.weight):
        assert parameter.grad is not None and parameter.grad.abs().sum() > 0


@pytest.mark.parametrize("frame", [np.zeros((1, 32, 32, 3), np.uint8), np.zeros((1, 64, 64, 3), np.float32)])
def test_frames_of_wrong_size_or_type_are_refused(estimator, termination, frame):
    with pytest.raises(ValueError, match="expected uint8"):
        estimator.step(EstimatorInput(frame, np.zeros((1, 3), np.float32)), estimator.initial_memory(1))
    inputs = TerminationInput(frame, np.zeros((1, BALL.proprio_size), np.float32), np.array([0]), np.array([False]))
    with pytest.raises(ValueError, match="expected uint8"):
        termination.probability(inputs, termination.initial_memory(1))


def test_a_pose_that_is_not_finite_is_refused(estimator, rng):
    pose = np.array([[0.0, np.nan, 0.0]], np.float32)
    with pytest.raises(ValueError, match="finite"):
        estimator.step(EstimatorInput(frames(rng, 1), pose), estimator.initial_memory(1))


def test_sizes_must_be_positive():
    with pytest.raises(ValueError, match="belief is 0"):
        StateEstimator(belief=0)


def driven(rng, heading, speed, ticks):
    """Proprioception of a robot that drives straight on, [1, T, P]."""
    proprio = np.zeros((1, ticks, BALL.proprio_size), np.float32)
    proprio[..., 0] = speed
    proprio[..., BALL.heading_index] = heading
    return proprio


@pytest.mark.parametrize(
    ("heading", "direction"), [(0.0, Instruction.EAST), (np.pi / 2, Instruction.NORTH), (np.pi, Instruction.WEST)]
)
def test_dead_reckoning_tells_how_far_it_is_to_the_next_cell_whatever_the_direction(
    termination, rng, heading, direction
):
    proprio = torch.from_numpy(driven(rng, heading, 1.0, 11))
    instruction = torch.full((1, 11), int(direction))
    progress, track = termination.odometry(
        proprio, instruction, torch.zeros(1, 11, dtype=torch.bool), termination.odometry.initial(1)
    )
    # 0.05 m a tick, half of it in the first: 0.525 m after 11 ticks; 0.475 m are left.
    np.testing.assert_allclose(progress[0, -1, 7:9].numpy(), [0.475, 0.0], atol=1e-5)
    assert track.elapsed.item() == 11


def test_after_a_push_the_next_cell_counts_from_the_cell_that_was_reached(termination):
    odometry = termination.odometry
    track = odometry.initial(1)._replace(
        position=torch.tensor([[1.45, 0.0]]), direction=torch.tensor([[1.0, 0.0]])
    )
    proprio = torch.zeros(1, 1, BALL.proprio_size)
    _, track = odometry(proprio, torch.tensor([[int(Instruction.NORTH)]]), torch.tensor([[True]]), track)
    assert track.origin.tolist() == [[1.0, 0.0]] and track.elapsed.item() == 1


@pytest.mark.parametrize("lean", [0.0, 0.25])
def test_a_body_without_a_compass_comes_back_to_where_it_began_after_a_circle(lean):
    odometry, ticks = Odometry(ANT), 200
    proprio = torch.zeros(1, ticks, ANT.proprio_size)
    proprio[..., 0] = 1.5
    # Leaning to its side, in a curve as on a banked track: its gyro feels the turn about two of its axes.
    up = torch.tensor([0.0, np.sin(lean), np.cos(lean)])
    proprio[..., ANT.proprio.up_axis] = up
    proprio[:, 1:, ANT.proprio.angular_velocity] = up * 2 * np.pi / (ticks * CONTROL_PERIOD)
    stay, no = torch.zeros(1, ticks, dtype=torch.int64), torch.zeros(1, ticks, dtype=torch.bool)
    heading = (CONTROL_PERIOD * ANT.proprio.turn_rate(proprio)).cumsum(1)
    tracks = odometry.follow(proprio, stay, no, odometry.initial(1), heading)
    assert odometry.features(proprio, tracks).shape == (1, ticks, FEATURES)
    # A circle of 15 m, in cells of 3 m.
    assert tracks.position[0, -1].abs().max() < 0.05
    assert float(tracks.position[0, ticks // 2 - 1].norm()) == pytest.approx(5.0 / np.pi, abs=0.05)


QUARTERS = (Instruction.EAST, Instruction.NORTH, Instruction.WEST, Instruction.SOUTH)


def made_for(body):
    torch.manual_seed(0)
    return ControlTermination(body=body.name, stem=8, channels=8, blocks=1, camera=8, hidden=8).eval()


@pytest.mark.parametrize("body", [BALL, ANT], ids=lambda body: body.name)
def test_progress_in_bits_equals_progress_at_once(body, rng):
    module = made_for(body)
    proprio = torch.from_numpy(rng.normal(size=(2, 20, body.proprio_size)).astype(np.float32))
    instruction = torch.from_numpy(rng.integers(0, 5, (2, 20)))
    terminated = torch.from_numpy(rng.random((2, 20)) < 0.2)
    shown = None if module.bearings is None else torch.from_numpy(rng.normal(size=(2, 20, SIGHT + PLACE))).float()
    track, needles = module.odometry.initial(2), module.initial_needles(2)
    whole = module.progress(shown, proprio, instruction, terminated, track, needles)
    parts = []
    for t in range(20):
        one = (x[:, t : t + 1] for x in (proprio, instruction, terminated))
        part = module.progress(None if shown is None else shown[:, t : t + 1], *one, track, needles)
        track, needles = part.track, part.needles
        parts.append(part.features)
    torch.testing.assert_close(whole.features, torch.cat(parts, 1))
    for last, at_once in zip(needles, whole.needles, strict=True):
        torch.testing.assert_close(last, at_once)


@pytest.mark.parametrize("quarter", [0, 1, 2, 3])
def test_an_ant_that_sees_where_it_is_knows_the_way_left_whatever_it_began_with(quarter):
    """It walks half a cell as instructed, facing 20 degrees off; its odometer and the needles begin wrong."""
    bearings, odometry, ticks = Bearings(ANT, 8), Odometry(ANT), 60
    direction = torch.tensor(OFFSETS_XY[list(QUARTERS)])
    psi = torch.tensor(quarter * np.pi / 2 + np.deg2rad(20.0), dtype=torch.float32)
    # The first half of the ticks it stands, and the needles settle.
    way = (torch.arange(1, ticks + 1) - ticks // 2).clamp(min=0)[:, None] / ticks * direction[quarter].float()
    middle = torch.tensor([1.5, -0.5])
    pose = torch.cat([ANT.cell_size * (middle + way), psi.expand(ticks, 1)], 1)
    proprio = torch.zeros(1, ticks, ANT.proprio_size)
    proprio[..., ANT.proprio.up_axis] = torch.tensor([0.0, 0.0, 1.0])
    speed = ANT.cell_size / (ticks * CONTROL_PERIOD)
    across = torch.tensor([np.cos(np.deg2rad(20.0)), -np.sin(np.deg2rad(20.0))])
    proprio[0, ticks // 2 :, ANT.proprio.planar_velocity] = (speed * across).float()
    heading = torch.zeros(ticks, SIGHT)
    heading[:, round(float(psi) / (2 * np.pi) * HEADINGS) % HEADINGS] = 12.0
    heading[:, HEADINGS:] = unit(4 * psi)
    shown = torch.cat([heading, phases_along(phases(pose, ANT.cell_size), direction[quarter].float())], -1)
    instruction = torch.full((1, ticks), int(QUARTERS[quarter]))
    issued = torch.zeros(1, ticks, dtype=torch.bool)
    issued[0, ticks // 2] = True
    track = odometry.initial(1)._replace(position=torch.tensor([[0.4, -3.3]]))
    progress = follow(bearings, odometry, shown[None], proprio, instruction, issued, track, bearings.initial(1))
    left = progress.features[0, -1, FEATURES + PLACE : FEATURES + PLACE + 2]
    np.testing.assert_allclose(left.numpy(), [0.5, 0.0], atol=0.02)


@pytest.mark.parametrize("body", [BALL, ANT], ids=lambda body: body.name)
def test_termination_steps_equal_training_on_an_instruction(body, rng):
    module, frame = made_for(body), frames(rng, 1, 6)
    proprio = rng.normal(size=(1, 6, body.proprio_size)).astype(np.float32)
    instruction, terminated = np.full((1, 6), 2), np.zeros((1, 6), bool)
    memory, stepped = module.initial_memory(1), []
    for t in range(6):
        inputs = TerminationInput(frame[:, t], proprio[:, t], instruction[:, t], terminated[:, t])
        p, memory = module.probability(inputs, memory)
        stepped.append(p[0])
    felt, *said = (torch.from_numpy(x) for x in (proprio, instruction, terminated))
    with torch.inference_mode():
        images = torch.from_numpy(frame[0])
        seen = module.look(module.encoder(images))
        shown = module.read(images, seen, felt[0])
        start = module.odometry.initial(1), module.initial_needles(1)
        progress = module.progress(None if shown is None else shown[None], felt, *said, *start)
        output = module(seen[None], progress.features, felt, *module.initial_recurrence(1))
    np.testing.assert_allclose(stepped, torch.sigmoid(output.logits[0]).numpy(), atol=1e-4)


def test_a_new_instruction_starts_the_lstm_afresh_but_not_the_odometer(termination, rng):
    proprio = rng.normal(size=(1, BALL.proprio_size)).astype(np.float32)
    memory = termination.initial_memory(1)
    first = TerminationInput(frames(rng, 1), proprio, np.array([1]), np.array([False]))
    _, memory = termination.probability(first, memory)
    issued = TerminationInput(frames(rng, 1), proprio, np.array([1]), np.array([True]))
    fresh = memory._replace(hidden=torch.zeros_like(memory.hidden), cell=torch.zeros_like(memory.cell))
    after, kept = termination.probability(issued, memory)
    expected, _ = termination.probability(issued, fresh)
    np.testing.assert_allclose(after, expected, atol=1e-6)
    assert kept.track.position.abs().sum() > 0


def test_weights_come_back_with_their_configuration(tmp_path, estimator, rng):
    small = StateEstimator(belief=8, update_every=2).eval()
    save_weights(tmp_path / "estimator.safetensors", small, small.hyperparameters(), {})
    loaded = load_weights(StateEstimator, tmp_path / "estimator.safetensors")
    assert loaded.config == small.config
    inputs = EstimatorInput(frames(rng, 1), poses(rng, 1))
    np.testing.assert_array_equal(
        loaded.step(inputs, loaded.initial_memory(1))[0], small.step(inputs, small.initial_memory(1))[0]
    )
    with pytest.raises(WeightsError, match="StateEstimator"):
        load_weights(ControlTermination, tmp_path / "estimator.safetensors")


def test_a_shared_encoder_is_saved_in_both_files(tmp_path, estimator):
    termination = ControlTermination(estimator.encoder)
    save_weights(tmp_path / "termination.safetensors", termination, termination.hyperparameters(), {})
    loaded = load_weights(ControlTermination, tmp_path / "termination.safetensors")
    for name, value in estimator.encoder.state_dict().items():
        assert torch.equal(loaded.encoder.state_dict()[name], value)


def test_belief_is_a_tuple_that_renews_by_rows(estimator):
    belief = Belief(torch.ones(2, 32, 10, 10), torch.ones(2, 32, 10, 10))
    renewed = renew_rows(belief, estimator.initial_belief(2), np.array([True, False]))
    assert renewed.hidden[0].sum() == 0 and renewed.cell[1].sum() > 0
