"""What the choice of labels does to verdicts, learned beside them.

Shapes: B states, D = 4 directions, I = 8.
"""

from __future__ import annotations

from typing import Final

import torch
from torch import Tensor, nn
from torch.nn import functional

CHOICES: Final = {"audit": 0, "way": 1, "verdict": 2}
"""`samples.Batch.choice` of samples of each kind: 0 where what is known does not hang on what it is."""


class LabelChoice(nn.Module):
    """Stretches and shifts the logits of verdicts on pushes as the choice of those that are known does.

    A solution is found sooner than the proof that there is none, so that of the pushes that are known fewer are deadly
    than of all: by 3 in the logit, where it was measured. How much that is, is learned from labels that were chosen
    otherwise, and then need not be learned by the network, which says how many of all pushes are deadly.
    """

    def __init__(self) -> None:
        """Begin with choices that change nothing."""
        super().__init__()
        self.stretch = nn.Parameter(torch.ones(len(CHOICES) - 1))
        self.shift = nn.Parameter(torch.zeros(len(CHOICES) - 1))

    def forward(self, logit: Tensor, choice: Tensor) -> Tensor:
        """Return the logits, [B, D, I, I], of what is known by each state's choice, int64 [B]."""
        stretch, shift = functional.pad(self.stretch, (1, 0), value=1.0), functional.pad(self.shift, (1, 0))
        return logit * stretch[choice][:, None, None, None] + shift[choice][:, None, None, None]
