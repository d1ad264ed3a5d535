"""The puzzle: levels, rules, bitboards, generator, solver."""
