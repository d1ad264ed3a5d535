"""The `ros2` command where there is none: the verbs that the graph needs, with the most used options."""
