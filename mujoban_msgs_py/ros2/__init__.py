"""The `ros2` command where there is none: the verbs that the graph needs, with the genuine options and output."""
