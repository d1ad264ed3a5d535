"""Losses, each a class or function of tensors alone."""
