"""The ROS interfaces of Mujoban: messages, topics, conversions, exact-stamp joins and bags."""
