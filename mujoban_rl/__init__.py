"""What the learned modules share: MPO, replay, weights, training runs, statistics."""
