"""kerv's own parts: their settings and what each needs. Nothing heavy is imported here."""

from __future__ import annotations

from kerv_cli.registry import Part, register
from kerv_cli.settings import RayOptions, SlurmOptions

register(Part("environment", "metaworld", "kerv_cli.environments.metaworld.spec:SPEC"))

register(Part("executor", "local", "kerv_cli.studies.executors.local:build", about="processes of this machine"))
register(
    Part(
        "executor",
        "slurm",
        "kerv_cli.studies.executors.slurm:build",
        settings=SlurmOptions,
        traits={"package": "submitit", "extra": "slurm"},
        about="jobs of a Slurm cluster",
    )
)
register(
    Part(
        "executor",
        "ray",
        "kerv_cli.studies.executors.ray:build",
        settings=RayOptions,
        traits={"package": "ray", "extra": "ray"},
        about="tasks of a Ray cluster",
    )
)
