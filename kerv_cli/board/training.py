"""The page of an artifact: what it was made from, what was made of it, and the curves of its training."""

from __future__ import annotations

from starlette.routing import Route

ROUTES: list[Route] = []
