"""What every node of the graph runs on: inputs joined by tick, executors, modules in nodes."""
