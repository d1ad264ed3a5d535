"""The simulated world: levels, rules, solver, physics, rendering, Gymnasium environments, simulator node."""
