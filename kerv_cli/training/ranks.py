"""Training on several processes, one per device: each computes its share of every batch, gradients are averaged.

`torchrun --nproc-per-node N` starts the processes and tells each its rank. The batch of a step does not depend on their
number, so neither does the run, but for the order in which gradients are added up. The first rank validates and writes.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import timedelta

import torch
import torch.distributed as dist
from torch import Tensor, nn

from kerv_cli.base.errors import UsageError
from kerv_cli.base.processes import end_with

PATIENCE = timedelta(hours=3)
"""How long a rank waits for the others: the first one may validate in closed loop meanwhile."""


@dataclass(frozen=True)
class Ranks:
    """The rank of this process among `size` processes."""

    rank: int = 0
    size: int = 1

    @property
    def first(self) -> bool:
        """Whether this process validates, writes and reports."""
        return self.rank == 0

    def share(self, batch: Tensor) -> Tensor:
        """This rank's part (B / size,) of a batch's indices (B,)."""
        return batch[self.rank :: self.size]

    def averaged(self, parameters: Iterable[nn.Parameter], numbers: Sequence[float]) -> list[float]:
        """Replaces the gradients by their mean over the ranks -> the mean of `numbers`."""
        if self.size == 1:
            return list(numbers)
        gradients = [p.grad for p in parameters if p.grad is not None]
        device = gradients[0].device if gradients else torch.device("cpu")
        extra = torch.tensor(numbers, dtype=torch.float32, device=device)
        flat = torch.cat([g.flatten().float() for g in gradients] + [extra])
        dist.all_reduce(flat)
        flat /= self.size
        begin = 0
        for gradient in gradients:
            gradient.copy_(flat[begin : begin + gradient.numel()].view_as(gradient))
            begin += gradient.numel()
        return [float(x) for x in flat[begin:]]

    def wait(self) -> None:
        """Until all ranks are here."""
        if self.size > 1:
            dist.barrier()


ALONE = Ranks()
"""One process."""


def join(device: str, batch: int) -> tuple[str, Ranks]:
    """Joins the other ranks that torchrun started, if it did -> (the device of this rank, the ranks). device: cpu or
    cuda; batch: samples of a step.

    Raises:
        UsageError: the batch cannot be divided, or a numbered device for several ranks.
    """
    ranks = Ranks(int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1")))
    if ranks.size == 1:
        return device, ranks
    if batch % ranks.size:
        raise UsageError(f"train.batch={batch} cannot be divided among {ranks.size} processes: set a multiple")
    if ":" in device:
        raise UsageError(f"runtime.device={device}: {ranks.size} processes would share it, set runtime.device=cuda")
    cuda = device.startswith("cuda")
    if cuda:
        device = f"cuda:{os.environ.get('LOCAL_RANK', '0')}"
        torch.cuda.set_device(device)
    if not dist.is_initialized():
        end_with(os.getppid())
        dist.init_process_group("nccl" if cuda else "gloo", timeout=PATIENCE)
    return device, ranks
