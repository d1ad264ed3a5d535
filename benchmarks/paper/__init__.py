"""The paper's tables and figures with our numbers beside them, rebuilt from the JSON of the evaluations."""
