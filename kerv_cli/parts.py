"""kerv's own parts: their settings and what each needs. Nothing heavy is imported here."""

from __future__ import annotations

from kerv_cli.registry import Part, register

register(Part("environment", "metaworld", "kerv_cli.environments.metaworld.spec:SPEC"))
register(Part("target", "compact", "kerv_cli.targets.compact.target:build", about="the shipped family"))
