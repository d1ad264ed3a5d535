"""Weights that ship: safetensors with a JSON record beside, both checked when they are loaded."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shlex
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as dump_tensors
from torch import Tensor, nn
from torch.nn.modules.module import register_module_parameter_registration_hook

from mujoban_core.commit import commit_of
from mujoban_core.files import digest, write_atomically

ModuleT = TypeVar("ModuleT", bound=nn.Module)


WEIGHTS_LIMIT = 1 << 30
"""Bytes of a file of weights or of a graph at most; the largest here has some 10 MB."""
RECORD_LIMIT = 1 << 24
"""Bytes of a record at most."""
SIZE_LIMIT = 1 << 16
"""Largest number in a configuration: beyond it no module of ours can be meant, and none is built."""


class WeightsError(ValueError):
    """A weights file or its record is missing, damaged, or does not fit the module."""


def record_path(path: str | Path) -> Path:
    """Return where the record of a weights file stands."""
    return Path(path).with_suffix(".json")


def provenance() -> dict[str, Any]:
    """Return the command line and commit that weights come from, for their record."""
    command = [Path(sys.argv[0]).name, *sys.argv[1:]]
    main = sys.modules.get("__main__")
    spec = getattr(main, "__spec__", None)
    if spec is not None and spec.name:
        command = ["python", "-m", spec.name.removesuffix(".__main__"), *sys.argv[1:]]
    return {"command": shlex.join(command), "commit": commit_of(Path(__file__)), "torch": torch.__version__}


def origin(path: str | Path | None) -> str | None:
    """Return the digest of the weights that a run begins with, for its record; None where it begins from nothing."""
    return None if path is None else digest(path)


def lineage(data: str, start: str | Path | None) -> str:
    """Return what weights learned from, for their record, with what those that they begin with learned from before."""
    if start is None:
        return data
    before = read_record(Path(start)).get("data", "not stated")
    return before if data in before.split("; then ") else f"{before}; then {data}"


def save_weights(
    path: str | Path, module: nn.Module, config: Any, record: Mapping[str, Any]
) -> None:
    """Write a module's weights and their record (`<name>.safetensors`, `<name>.json`).

    Args:
        path: File to write; must end in `.safetensors`.
        module: Module whose `state_dict` is written, as contiguous CPU tensors.
        config: Keyword arguments that rebuild the module: a mapping or a dataclass, JSON-serialisable.
        record: What else the record says (command, data, commit, steps, metrics; see `provenance`).

    Raises:
        WeightsError: If a weight is not finite or the name does not end in `.safetensors`.
    """
    path = Path(path)
    if path.suffix != ".safetensors":
        raise WeightsError(f"expected a file name that ends in .safetensors, got {path}")
    fields = dataclasses.asdict(config) if dataclasses.is_dataclass(config) else dict(config)  # type: ignore[arg-type]
    tensors = {k: v.detach().cpu().contiguous().clone() for k, v in module.state_dict().items()}
    check_finite(tensors, str(path))
    data = dump_tensors(tensors, {"class": type(module).__name__})
    content = {
        "class": type(module).__name__,
        "config": fields,
        "parameters": sum(p.numel() for p in module.parameters()),
        "digest": hashlib.sha256(data).hexdigest(),
        **record,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps(content, indent=2, allow_nan=False) + "\n"
    write_atomically(path, data)
    write_atomically(record_path(path), text.encode())


def check_weights_exist(path: str | Path) -> None:
    """Check that there is a weights file.

    Raises:
        WeightsError: If there is none.
    """
    if not Path(path).is_file():
        raise WeightsError(f"{path}: no such weights file; expected .safetensors written by a train command")


def read_record(path: str | Path) -> dict[str, Any]:
    """Return the record beside a weights file.

    Raises:
        WeightsError: If it is missing or is not a record.
    """
    file = record_path(path)
    if not file.is_file():
        check_weights_exist(path)
        raise WeightsError(f"{file}: no record beside the weights; expected a JSON file")
    try:
        content = json.loads(read_bounded(file, RECORD_LIMIT))
    except (ValueError, RecursionError) as error:
        raise WeightsError(f"{file}: not a JSON record: {error}") from None
    if not isinstance(content, dict) or not {"class", "config", "digest"} <= content.keys():
        raise WeightsError(f"{file}: expected a JSON object with keys class, config and digest")
    for key, kind in (("class", str), ("config", dict), ("digest", str), ("graph", str)):
        if key in content and not isinstance(content[key], kind):
            raise WeightsError(f"{file}: {key} is {str(content[key])[:40]!r}, expected a {kind.__name__}")
    for name, value in content["config"].items():
        for item in value if isinstance(value, list) else [value]:
            if not isinstance(item, str | int | float) or (not isinstance(item, str) and not abs(item) <= SIZE_LIMIT):
                raise WeightsError(
                    f"{file}: {name} is {str(value)[:40]} in its configuration, expected texts and numbers up to "
                    f"{SIZE_LIMIT}"
                )
    return content


def read_bounded(path: Path, limit: int) -> bytes:
    """Return the content of a regular file of at most `limit` bytes.

    Raises:
        WeightsError: If it is none, or longer.
        OSError: If it cannot be read.
    """
    if not path.is_file():
        raise WeightsError(f"{path}: no such file")
    if (size := path.stat().st_size) > limit:
        raise WeightsError(f"{path}: has {size} bytes, expected at most {limit}")
    return path.read_bytes()


def usable_device(device: str | torch.device) -> torch.device:
    """Return a device that modules can be put on.

    Raises:
        WeightsError: If there is no such device on this machine.
    """
    try:
        chosen = torch.device(device)
    except RuntimeError:
        raise WeightsError(f"device {str(device)!r}: expected cpu or cuda, such as cuda:0") from None
    if chosen.type not in ("cpu", "cuda"):
        raise WeightsError(f"device {str(device)!r}: expected cpu or cuda, such as cuda:0")
    if chosen.type == "cuda" and (chosen.index or 0) >= (found := torch.cuda.device_count()):
        raise WeightsError(f"device {str(device)!r}: torch can use {found} CUDA devices here, expected cpu")
    return chosen


def load_weights(
    cls: type[ModuleT], path: str | Path, device: str | torch.device = "cpu", *, body: str | None = None
) -> ModuleT:
    """Build `cls(**config)` from a record and load its weights, in evaluation mode.

    Args:
        cls: Class of the module; its name must be the one in the record.
        path: The `.safetensors` file; its record stands beside it.
        device: Where the module is put.
        body: Key in `mujoban_core.bodies.BODIES` of that which the weights have to be of; any, if None.

    Raises:
        WeightsError: If a file is missing or damaged (digest), or class, body, configuration or shapes do not fit.
    """
    path, chosen = Path(path), usable_device(device)
    check_weights_exist(path)
    record = read_record(path)
    data = read_bounded(path, WEIGHTS_LIMIT)
    if (found := hashlib.sha256(data).hexdigest()) != record["digest"]:
        raise WeightsError(f"{path}: damaged or not the file of its record: SHA-256 is {found}, not {record['digest']}")
    if record["class"] != cls.__name__:
        raise WeightsError(f"{path}: holds weights of {record['class']}, expected {cls.__name__}")
    if body is not None and (found := record["config"].get("body")) != body:
        raise WeightsError(f"{path}: weights of the body {found}, expected {body}")
    try:
        tensors = load_tensors(data)
    except (SafetensorError, ValueError, KeyError) as error:
        raise WeightsError(f"{path}: not a safetensors file: {error}") from None
    # Without memory at first: what the configuration asks for must be what the file holds.
    with torch.device("meta"), _at_most(len(tensors)):
        _check_shapes(tensors, _build(cls, record["config"], path).state_dict(), path)
    check_finite(tensors, str(path))
    module = _build(cls, record["config"], path)
    module.load_state_dict(tensors)
    return module.to(chosen).eval()


@contextmanager
def _at_most(count: int) -> Iterator[None]:
    """Stop the building of modules with more than `count` parameters in all, which may take for ever."""
    built = 0

    def count_one(*_: object) -> None:
        nonlocal built
        built += 1
        if built > count:
            raise ValueError(f"it asks for more than the {count} tensors of the file")

    handle = register_module_parameter_registration_hook(count_one)
    try:
        yield
    finally:
        handle.remove()


def _build(cls: type[ModuleT], config: Mapping[str, Any], path: Path) -> ModuleT:
    """Return a module of a configuration from a record."""
    try:
        return cls(**config)
    except (WeightsError, MemoryError):
        raise
    except Exception as error:  # whatever a module makes of numbers that it was never meant for
        reason = " ".join(str(error).split()).partition(" Exception raised from")[0]
        raise WeightsError(f"{path}: configuration does not fit {cls.__name__}: {reason}") from None


def check_finite(tensors: Mapping[str, Tensor], where: str) -> None:
    """Raise `WeightsError` naming the first tensor that holds a NaN or an infinity."""
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
            raise WeightsError(f"{where}: {name} is not finite")


def _check_shapes(tensors: Mapping[str, Tensor], expected: Mapping[str, Tensor], path: Path) -> None:
    missing, extra = sorted(expected.keys() - tensors.keys()), sorted(tensors.keys() - expected.keys())
    if missing or extra:
        raise WeightsError(f"{path}: missing weights {missing[:4]}, unexpected weights {extra[:4]}")
    for name, tensor in expected.items():
        if tensor.shape != tensors[name].shape:
            got, want = tuple(tensors[name].shape), tuple(tensor.shape)
            raise WeightsError(f"{path}: {name} has shape {got}, expected {want}")
        if tensor.is_floating_point() != tensors[name].is_floating_point():
            raise WeightsError(f"{path}: {name} is of type {tensors[name].dtype}, expected {tensor.dtype}")
