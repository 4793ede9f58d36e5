"""The executors that kerv has itself, and the options of each; imported for what it registers."""

from __future__ import annotations

from dataclasses import dataclass, field

from kerv_cli.base.limits import number
from kerv_cli.base.registry import Part, register


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


register(Part("executor", "local", "kerv_cli.lab.executors.local:build", LocalOptions))
for _name, _package, _options in (("slurm", "submitit", SlurmOptions), ("ray", "ray", RayOptions)):
    _traits = {"package": _package, "extra": _name}
    register(Part("executor", _name, f"kerv_cli.lab.executors.{_name}:build", _options, traits=_traits))
