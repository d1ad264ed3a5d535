"""The directory of a training run: configuration, checkpoints, learning curve."""

from __future__ import annotations

import dataclasses
import json
import os
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from mujoban_core.files import LOCK, digest, naming, replacing_alone, write_atomically
from mujoban_rl.weights import check_finite

_ANOTHER = "choose another directory"
_CONFIG: Final = "config.json"
_CHECKPOINTS: Final = "checkpoint-*.safetensors"
_SYSTEM_ERROR: Final = re.compile(r"\(os error (\d+)\)")


class RunError(ValueError):
    """A run directory cannot be used: another configuration, or no intact checkpoint."""


@dataclasses.dataclass(frozen=True)
class Snapshot:
    """What a checkpoint holds beside the modules and optimisers that were restored in place."""

    step: int
    extra: dict[str, Any]
    """JSON values: random states, schedules, counters."""
    tensors: dict[str, Tensor]
    """Loose tensors, such as `torch.Generator` states."""
    light: bool = False
    """Whether it holds modules and parts of `extra` and `tensors` alone (see `copy_light`)."""


class RunDirectory:
    """Directory of one training run: `config.json`, checkpoints, `metrics.jsonl`, TensorBoard events.

    Checkpoints are `checkpoint-<step>.safetensors` with a JSON part beside that is written last, so a file pair
    is whole or is ignored. The last `keep` survive.

    Attributes:
        options: The configuration as `config.json` has it.
        config: The same with what stands beside it.
    """

    def __init__(
        self, path: str | Path, config: Any, *, beside: Mapping[str, Any] | None = None, keep: int = 2
    ) -> None:
        """Create the directory, or reopen it when its configuration is the same.

        One in which nothing has been done yet takes a new configuration: a start that failed, for instance at a file
        that is missing, does not stand in the way of the next.

        Args:
            path: Directory; an existing one is resumed.
            config: Dataclass or mapping; what must not change between the bits of a run. Options that have come since
                it began have to be at their defaults.
            beside: JSON values that must not change either and are no options: a method, what the run began with. One
                that was not noted yet when the run began is taken at its word.
            keep: Number of checkpoints kept.

        Raises:
            RunError: If the directory belongs to a run with another configuration, or to none.
        """
        self.path = Path(path)
        self.keep = keep
        self.options, fixed = _as_json(config), _as_json(beside or {})
        self.config = self.options | fixed
        self.path.mkdir(parents=True, exist_ok=True)
        file = self.path / _CONFIG
        if file.exists() and any(other.name not in (_CONFIG, LOCK) for other in self.path.iterdir()):
            # An option that there was not yet when the run began is as if it had been left alone.
            stored = _overlaid(_defaults(config), fixed | _read_config(file))
            changed = sorted(k for k in stored.keys() | self.config.keys() if stored.get(k) != self.config.get(k))
            if changed:
                # What else there is belongs to the one method or the other.
                changed = ["method"] if "method" in changed else changed
                pairs = ", ".join(f"{k}: {stored.get(k)!r} there, {self.config.get(k)!r} now" for k in changed)
                raise RunError(f"{self.path}: a run with another configuration ({pairs}); {_ANOTHER}")
        elif self._checkpoints():
            raise RunError(f"{self.path}: has checkpoints but no {file.name}, expected both or neither; {_ANOTHER}")
        else:
            write_atomically(file, (json.dumps(self.config, indent=2) + "\n").encode())

    def save(
        self,
        step: int,
        *,
        modules: Mapping[str, nn.Module],
        optimisers: Mapping[str, torch.optim.Optimizer] | None = None,
        extra: Mapping[str, Any] | None = None,
        tensors: Mapping[str, Tensor] | None = None,
    ) -> Path:
        """Write a checkpoint atomically, then drop the oldest ones.

        Args:
            step: Number of training steps done.
            modules: Modules by name; their `state_dict` is stored.
            optimisers: Optimisers by name; moments and hyper-parameters are stored.
            extra: JSON-serialisable values.
            tensors: Further tensors.

        Returns:
            Path of the safetensors file.

        Raises:
            WeightsError: If a value is not finite; no file is written then.
            OSError: If the disk is full or cannot be written to; the checkpoints before this one stay.
        """
        flat: dict[str, Tensor] = {}
        for name, module in modules.items():
            flat |= {f"module/{name}/{k}": v for k, v in module.state_dict().items()}
        scalars: dict[str, Any] = {}
        for name, optimiser in (optimisers or {}).items():
            moments, scalars[name] = _split_optimiser(optimiser.state_dict())
            flat |= {f"optimiser/{name}/{k}": v for k, v in moments.items()}
        flat |= {f"tensor/{k}": v for k, v in (tensors or {}).items()}
        flat = _separate(flat)
        check_finite(flat, f"checkpoint at step {step}")
        content: dict[str, Any] = {"step": step, "optimisers": scalars, "extra": dict(extra or {})}
        json.dumps(content, allow_nan=False)  # before anything is written
        for lone in set(self.path.glob(_CHECKPOINTS)) - set(self._checkpoints()):
            lone.unlink()
        path = self.path / f"checkpoint-{step:010d}.safetensors"
        # Into a file and not into memory: a replay may take up most of that.
        with naming(path), replacing_alone(path) as temporary:
            _save(flat, temporary)
            content["digest"] = digest(temporary)
        try:
            write_atomically(path.with_suffix(".json"), json.dumps(content).encode())
        except OSError:
            path.unlink(missing_ok=True)  # without the other half it is none
            raise
        for old in self._checkpoints()[self.keep :]:
            old.unlink(missing_ok=True)
            old.with_suffix(".json").unlink(missing_ok=True)
        return path

    def load(
        self,
        *,
        modules: Mapping[str, nn.Module],
        optimisers: Mapping[str, torch.optim.Optimizer] | None = None,
    ) -> Snapshot | None:
        """Restore the newest intact checkpoint in place; return None when there is no checkpoint.

        A light one leaves optimisers as they are.

        Raises:
            RunError: If there are checkpoints but none is intact, or they are of another kind of run.
        """
        if (found := _newest_intact(self.path)) is None:
            return None
        _, content, flat = found
        with self.reading(content.get("step")):
            for name, module in modules.items():
                module.load_state_dict(_below(flat, f"module/{name}/"))
            light = content.get("light", False)
            for name, optimiser in ({} if light else optimisers or {}).items():
                state = _join_optimiser(_below(flat, f"optimiser/{name}/"), content["optimisers"][name])
                optimiser.load_state_dict(state)
                _lay_out(optimiser)
            return Snapshot(content["step"], content["extra"], _below(flat, "tensor/"), light)

    @property
    def began(self) -> int:
        """Samples that a run had when it was copied lightly: what comes then is drawn apart. 0 if it was not."""
        if not (checkpoints := self._checkpoints()):
            return 0
        with suppress(ValueError, KeyError, TypeError):  # what is damaged is named where it is loaded
            content = json.loads(checkpoints[0].with_suffix(".json").read_text())
            extra = content["extra"]
            return int(extra["progress"]["samples"] if content.get("light") else extra.get("began", 0))
        return 0

    @contextmanager
    def reading(self, step: int | None) -> Iterator[None]:
        """Say of what fails inside that the checkpoint of a step is not of this kind of run.

        Raises:
            RunError: If it lacks an entry, or an entry does not fit.
        """
        try:
            yield
        except (AttributeError, IndexError, KeyError, RuntimeError, TypeError, ValueError) as error:
            what = f"no entry {error}" if isinstance(error, KeyError) else " ".join(str(error).split())[:200]
            raise RunError(
                f"{self.path}: its checkpoint at step {step} is of another version or kind of run ({what}), "
                f"expected one that this trainer wrote; {_ANOTHER}"
            ) from error

    def _checkpoints(self) -> list[Path]:
        return _newest_first(self.path)


def copy_light(run: Path, out: Path, parts: Collection[str]) -> Path | None:
    """Write a light copy of a run's newest intact checkpoint: modules, parts of the rest; matrices at half precision.

    A run that goes on from it begins anew with its optimisers and with all that it has gathered, which may be a
    thousand times as large: to carry a run elsewhere, not to go on as one that never stopped.

    Args:
        run: Directory of the run.
        out: Directory that gets the copy and the run's configuration; it is made if it does not exist.
        parts: Names of the values and tensors to keep, those of parts of a part with a dot; it may lack some.

    Returns:
        Path of its safetensors file; None if the run has no checkpoint.

    Raises:
        RunError: If it has checkpoints but none is intact.
    """
    if (found := _newest_intact(run)) is None:
        return None
    path, content, flat = found
    prefixes = ("module/", *(f"tensor/{name}." for name in parts))
    tensors = {k: _halved(v) for k, v in flat.items() if k.startswith(prefixes)}
    check_finite(tensors, f"light copy of {path}")
    kept: dict[str, Any] = {}
    for name in parts:
        kept = _overlaid(kept, _path_to(content["extra"], name.split(".")))
    out.mkdir(parents=True, exist_ok=True)
    write_atomically(out / _CONFIG, (run / _CONFIG).read_bytes())
    target = out / path.name
    _save(tensors, target)
    light = {"step": content["step"], "light": True, "extra": kept, "digest": digest(target)}
    write_atomically(target.with_suffix(".json"), json.dumps(light).encode())
    return target


def _path_to(values: Mapping[str, Any], names: Sequence[str]) -> dict[str, Any]:
    """Return nested mappings with nothing in them but the value under nested names; empty where that is missing."""
    first, *rest = names
    if first not in values:
        return {}
    return {first: _path_to(values[first], rest) if rest else values[first]}


def _halved(values: Tensor) -> Tensor:
    """Return a matrix of weights at half precision, and as it is what is small and may be large in value: counts."""
    return values.half() if values.is_floating_point() and values.dim() > 1 else values


def _newest_intact(directory: Path) -> tuple[Path, dict[str, Any], dict[str, Tensor]] | None:
    """Return path, JSON and tensor parts of the newest checkpoint that is not damaged; None if there is none at all.

    Raises:
        RunError: If there are checkpoints but none is intact.
    """
    candidates = _newest_first(directory)
    for path in candidates:
        if (loaded := _read_checkpoint(path)) is not None:
            return path, *loaded
    if candidates:
        raise RunError(f"{directory}: none of {len(candidates)} checkpoints is intact")
    return None


def _newest_first(directory: Path) -> list[Path]:
    """Return the checkpoints of a run; of one without its JSON part its process was killed while it wrote it."""
    found = sorted(directory.glob(_CHECKPOINTS), reverse=True)
    return [path for path in found if path.with_suffix(".json").exists()]


def _as_json(config: Any) -> dict[str, Any]:
    """Return a configuration, a dataclass or a mapping, as the file has it."""
    content = config if dataclasses.is_dataclass(config) else dict(config)
    # JSON has no numbers that are not finite.
    return json.loads(json.dumps(content, default=_plain), parse_constant=str)


def _plain(value: Any) -> Any:
    """Return what JSON has for a value that it does not know: an object of settings, or text."""
    return dataclasses.asdict(value) if dataclasses.is_dataclass(value) else str(value)  # type: ignore[arg-type]


def _defaults(config: Any) -> dict[str, Any]:
    """Return the options of a configuration that have defaults, with these, as the file would have them."""
    if not dataclasses.is_dataclass(config):
        return {}
    found: dict[str, Any] = {}
    for option in dataclasses.fields(config):
        if option.default is not dataclasses.MISSING:
            found[option.name] = option.default
        elif option.default_factory is not dataclasses.MISSING:
            found[option.name] = option.default_factory()
    return _as_json(found)


def _overlaid(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Return what two nested mappings hold; where both hold a value, that of the second."""
    merged = below | above
    for key in below.keys() & above.keys():
        if isinstance(below[key], dict) and isinstance(above[key], dict):
            merged[key] = _overlaid(below[key], above[key])
    return merged


def _read_config(file: Path) -> dict[str, Any]:
    """Return the configuration that a run was begun with."""
    try:
        stored = json.loads(file.read_text(), parse_constant=str)
    except ValueError:
        stored = None
    if not isinstance(stored, dict):
        raise RunError(f"{file}: no JSON object, expected the configuration of a run; {_ANOTHER}")
    return stored


def _read_checkpoint(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]] | None:
    """Return the JSON and tensor parts of a checkpoint, or None when it is damaged."""
    try:
        content = json.loads(path.with_suffix(".json").read_text())
        return (content, load_file(path)) if digest(path) == content["digest"] else None
    except (OSError, ValueError, TypeError, KeyError, SafetensorError):
        return None


def _save(tensors: Mapping[str, Tensor], path: Path) -> None:
    """Write a safetensors file; an error of the system is one here as well, with its number."""
    try:
        save_file(dict(tensors), path)
    except SafetensorError as error:
        if (number := _SYSTEM_ERROR.search(str(error))) is None:
            raise
        raise OSError(int(number[1]), os.strerror(int(number[1])), str(path)) from error


def _separate(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return tensors on the CPU of which no two share memory, as safetensors demands; copies are made only for that."""
    found: dict[str, Tensor] = {}
    taken: set[int] = set()
    for name, tensor in tensors.items():
        own = tensor.detach().cpu().contiguous()
        own = own.clone() if own.untyped_storage().data_ptr() in taken else own
        taken.add(own.untyped_storage().data_ptr())
        found[name] = own
    return found


def _below(flat: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {k.removeprefix(prefix): v for k, v in flat.items() if k.startswith(prefix)}


def _lay_out(optimiser: torch.optim.Optimizer) -> None:
    """Lay moments out in memory as the parameters are, which may be channels-last: fused optimisers rely on it."""
    for parameter, moments in optimiser.state.items():
        for key, value in moments.items():
            # Steps are counted on the CPU or where the parameter is, as the optimiser has it.
            if key != "step" and isinstance(value, Tensor) and value.shape == parameter.shape:
                moments[key] = torch.empty_like(parameter, dtype=value.dtype).copy_(value)


def _split_optimiser(state: dict[str, Any]) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Split an optimiser's state into tensors by `parameter/key` and the JSON rest."""
    moments: dict[str, Tensor] = {}
    rest: dict[str, dict[str, Any]] = {}
    for index, values in state["state"].items():
        for key, value in values.items():
            if isinstance(value, Tensor):
                moments[f"{index}/{key}"] = value
            else:
                rest.setdefault(str(index), {})[key] = value
    return moments, {"state": rest, "param_groups": state["param_groups"]}


def _join_optimiser(moments: Mapping[str, Tensor], scalars: dict[str, Any]) -> dict[str, Any]:
    state: dict[int, dict[str, Any]] = {int(k): dict(v) for k, v in scalars["state"].items()}
    for name, value in moments.items():
        index, key = name.split("/", 1)
        state.setdefault(int(index), {})[key] = value
    return {"state": state, "param_groups": scalars["param_groups"]}
