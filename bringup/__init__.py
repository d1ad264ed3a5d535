"""Run the whole stack: batched rollout, evaluation, the ROS graph in one or several processes, recording."""
