"""The contract between the modules of sense-plan-act, and what all of them know of the world they act in."""
