"""What evaluation counts: layers of the map by whether they were seen, calibration, termination's hits and delays.

Shapes: B robots, K ticks at which the estimator has answered.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from mujoban_core.grid import AGENT, BOX, CHANNELS, GRID_SIZE
from mujoban_estimator.estimator import BINARY

_BINS: Final = 10
SLACK: Final = 3
"""Ticks that a recording must go on after an instruction's completion for its detection to count."""
_ON_TIME: Final = 2
"""Ticks between completion and detection that make no difference to what follows."""
_INNER: Final = (slice(None), slice(1, -1), slice(1, -1))
"""Cells that are not the outer wall, which needs no estimate."""


class MapScores:
    """Counts how estimates compare with the truth."""

    def __init__(self) -> None:
        self.frames = 0
        self._agent = 0
        self._boxes_right = 0
        self._boxes_shown = np.zeros(2, np.int64)
        # By layer, and by whether a cell is in view, was in view before, or never was: true and false answers.
        self._counts = np.zeros((len(BINARY), 3, 2, 2), np.int64)
        self._calibration = np.zeros((len(BINARY), _BINS, 3))

    def add(
        self,
        probability: NDArray[np.float32],
        truth: NDArray[np.float32],
        in_view: NDArray[np.bool_],
        seen: NDArray[np.bool_],
    ) -> None:
        """Count M estimates.

        Args:
            probability: of each layer, [M, 10, 10, 4].
            truth: abstract states, [M, 10, 10, 4].
            in_view: cells in view, [M, 10, 10].
            seen: cells that are or were in view, [M, 10, 10].
        """
        self.frames += len(truth)
        cells = GRID_SIZE * GRID_SIZE
        where = probability[..., AGENT].reshape(-1, cells).argmax(-1) == truth[..., AGENT].reshape(-1, cells).argmax(-1)
        self._agent += int(where.sum())
        right = ((probability[..., BOX] > 0.5) == (truth[..., BOX] > 0.5)).all(axis=(1, 2))
        shown = (seen | (truth[..., BOX] < 0.5)).all(axis=(1, 2))
        self._boxes_right += int(right.sum())
        self._boxes_shown += (int((right & shown).sum()), int(shown.sum()))
        group = np.where(in_view, 0, np.where(seen, 1, 2))[_INNER].ravel()
        for i, layer in enumerate(BINARY):
            p, y = probability[..., layer][_INNER].ravel(), truth[..., layer][_INNER].ravel() > 0.5
            np.add.at(self._counts[i], (group, y.astype(int), (p > 0.5).astype(int)), 1)
            known = group < 2
            bins = np.minimum((p[known] * _BINS).astype(int), _BINS - 1)
            for j, value in enumerate((np.ones(bins.size), p[known], y[known])):
                np.add.at(self._calibration[i, :, j], bins, value)

    def report(self) -> dict[str, float]:
        """Return rates; cells of the outer wall do not count."""
        rates: dict[str, float] = {"agent_accuracy": _share(self._agent, self.frames)}
        for i, layer in enumerate(BINARY):
            name, by_view = CHANNELS[layer], self._counts[i]
            known = by_view[:2].sum(axis=0)
            rates[f"{name}_accuracy_seen"] = _share(int(np.trace(known)), int(known.sum()))
            rates[f"{name}_precision_seen"] = _share(int(known[1, 1]), int(known[:, 1].sum()))
            for group, text in enumerate(("in_view", "seen_before", "never_seen")):
                rates[f"{name}_recall_{text}"] = _share(int(by_view[group, 1, 1]), int(by_view[group, 1].sum()))
            n, predicted, true = self._calibration[i].T
            rates[f"{name}_calibration_error"] = _share(float(np.abs(predicted - true).sum()), float(n.sum()))
        rates["boxes_all_right"] = _share(self._boxes_right, self.frames)
        rates["boxes_all_right_if_seen"] = _share(int(self._boxes_shown[0]), int(self._boxes_shown[1]))
        return rates


class TerminationScores:
    """Counts, by instruction, when its completion is detected."""

    def __init__(self) -> None:
        self._early: list[int] = []
        """Ticks by which detections came before completion; a large number where it never came."""
        self._delays: list[int] = []
        self._hits = 0
        self._missed = 0
        self._on_time: list[bool] = []
        """Of instructions that were completed, and recorded for long enough to tell, or ended without having been."""

    def add(self, probability: NDArray[np.float32], completed: NDArray[np.bool_], threshold: float) -> None:
        """Count the ticks of one instruction, [T], until it was ended in the recording."""
        detection = _first(probability > threshold)
        onset = _first(completed)
        if onset is None:
            self._on_time += [False] * (detection is not None)
        elif len(completed) - onset > _ON_TIME:
            self._on_time.append(detection is not None and abs(detection - onset) <= _ON_TIME)
        if detection is not None and (onset is None or detection < onset):
            self._early.append((onset if onset is not None else 1_000) - detection)
        elif detection is not None:
            self._hits += 1
        if onset is None or len(completed) - onset <= SLACK or (detection is not None and detection < onset):
            return
        if detection is None:
            self._missed += 1
        else:
            self._delays.append(detection - onset)

    def report(self) -> dict[str, float]:
        """Return precision, recall and delay, and the share that was told on time, which is all of them in one."""
        early = np.array(self._early)
        return {
            "termination_on_time": _share(sum(self._on_time), len(self._on_time)),
            "termination_precision": _share(self._hits, self._hits + len(early)),
            "termination_early_by_over_2_ticks": _share(int((early > 2).sum()), self._hits + len(early)),
            "termination_recall": _share(len(self._delays), len(self._delays) + self._missed),
            "termination_mean_delay": float(np.mean(self._delays)) if self._delays else float("nan"),
            "termination_delay_90": float(np.quantile(self._delays, 0.9)) if self._delays else float("nan"),
            "termination_instructions": float(self._hits + len(early) + self._missed),
        }


def _first(flags: NDArray[np.bool_]) -> int | None:
    return int(flags.argmax()) if flags.any() else None


def _share(part: float, whole: float) -> float:
    return part / whole if whole else float("nan")
