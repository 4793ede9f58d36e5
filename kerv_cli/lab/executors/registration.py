"""The executors that kerv has itself, and the options of each; imported for what it registers."""

from __future__ import annotations

from dataclasses import dataclass, field

from kerv_cli.base.limits import number
from kerv_cli.base.registry import add


@dataclass
class LocalOptions:
    """The local executor has no `runtime.executor_options`."""


@dataclass
class SlurmOptions:
    """`runtime.executor_options` of slurm: a block is a job."""

    cluster: str = "slurm"  # slurm | local (submitit's own processes on this machine)
    partition: str = ""  # empty: the cluster's default
    minutes: int = number(120, 1, 100_000)  # longest time of a job
    memory_gb: int = number(8, 1, 100_000)
    gpus: int = number(0, 0, 1024)
    setup: list[str] = field(default_factory=list)  # shell lines before the job's Python starts


@dataclass
class RayOptions:
    """`runtime.executor_options` of ray: a block is a task."""

    address: str = ""  # of a running cluster, e.g. auto or ray://host:10001; empty: a Ray of its own on this machine
    gpus: float = number(0.0, 0, 1024)  # per block


add("executor", "local", "kerv_cli.lab.executors.local:build", LocalOptions)
add("executor", "slurm", "kerv_cli.lab.executors.slurm:build", SlurmOptions, package="submitit", extra="slurm")
add("executor", "ray", "kerv_cli.lab.executors.ray:build", RayOptions, package="ray", extra="ray")
