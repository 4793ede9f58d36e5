"""What a public drafter's convention costs in acceptance (docs/methods.md §2.2), on the tiny OpenVLA checkpoint.

Trains two drafters for some seconds, one under each mask, and decodes the observations they were trained on with every
convention: tokens committed per verification, strict, a chain of five. Run it with

    python tests/public_conventions.py
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from examples.tiny_openvla import write_checkpoint
from test_openvla import imported, loaded, shown
from test_public_drafter import LANGUAGE, PATCHES, with_convention
from torch import Tensor

from kerv_cli.engine.batched import greedy
from kerv_cli.methods.eagle import DrafterSettings
from kerv_cli.methods.eagle.public import MASKS, POSITIONS, Convention, PublicDrafter, PublicShape
from kerv_cli.targets.openvla.target import OpenVLATarget
from kerv_cli.training.distillation import Distillation, StatesByLength, TeacherStates, acceptance_length

OBSERVATIONS, STEPS = 64, 600


@contextmanager
def seen_by_the_prompt_alone(drafter: PublicDrafter, length: int) -> Iterator[None]:
    """Trains under a convention's mask: without a cache the prompt's length has to be told."""
    cacheless = drafter.prompt_mask

    def mask(x: Tensor, cache: object, seen: np.ndarray | None) -> Tensor:
        made = x.new_zeros(x.shape[1], x.shape[1]).masked_fill(
            torch.ones(x.shape[1], x.shape[1]).triu(1) > 0, -torch.inf
        )
        made[:, length - 1 :] = -torch.inf
        return made

    drafter.prompt_mask = mask  # type: ignore[method-assign]
    yield
    drafter.prompt_mask = cacheless  # type: ignore[method-assign]


def distilled(target: OpenVLATarget, convention: Convention, steps: int = STEPS) -> PublicDrafter:
    torch.manual_seed(0)
    drafter = PublicDrafter(PublicShape(LANGUAGE, True, convention, PATCHES))
    with torch.inference_mode():
        prompts = torch.cat([target.encode(shown(seed)) for seed in range(OBSERVATIONS)])
        tokens, hidden = greedy(target, prompts)
    states = StatesByLength((TeacherStates(prompts.clone(), hidden.clone(), tokens.clone()),))
    run = Distillation(drafter, target, states, states, DrafterSettings(unroll=2))  # type: ignore[arg-type]
    optimiser = torch.optim.AdamW(drafter.parameters(), 3e-3)
    with seen_by_the_prompt_alone(drafter, prompts.shape[1]):
        for step in range(steps):
            loss, _ = run.loss(torch.randint(len(prompts), (24,)), step)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
    return drafter.eval().requires_grad_(False)


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        results = Path(folder)
        target = loaded(imported(write_checkpoint(results / "tiny"), results))
        with torch.inference_mode():
            prompts = [target.encode(shown(seed)) for seed in range(OBSERVATIONS)]
        for trained in MASKS:
            drafter = distilled(target, Convention(mask=trained))
            for positions in POSITIONS:
                for mask in MASKS:
                    own = with_convention(drafter, Convention(positions, mask))
                    length = acceptance_length(target, own, prompts, 0)
                    print(f"trained mask={trained}  positions={positions} mask={mask}  AL {length:.2f}", flush=True)


if __name__ == "__main__":
    main()
