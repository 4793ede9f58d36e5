"""kerv's own parts: their settings and what each needs. Nothing heavy is imported here."""

from __future__ import annotations

from kerv_cli.registry import Part, register

register(
    Part(
        "environment",
        "metaworld",
        "kerv_cli.environments.metaworld.spec:SPEC",
        traits={"names": "kerv_cli.environments.metaworld.tasks:NAMES"},
    )
)
register(
    Part(
        "environment",
        "insertion",
        "kerv_cli.environments.insertion.spec:SPEC",
        traits={"names": "kerv_cli.environments.insertion.tasks:NAMES"},
    )
)
register(Part("target", "compact", "kerv_cli.targets.compact.target:build", about="the shipped family"))
