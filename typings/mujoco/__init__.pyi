# mujoco ships its classes in extension modules without stubs; this keeps the type checker from rejecting them all.
from typing import Any

def __getattr__(name: str) -> Any: ...
