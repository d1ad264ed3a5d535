"""What frames tell of a robot's pose, where it faces and where in its cell it is, and the needles that keep it."""
