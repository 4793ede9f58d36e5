"""The pages of a study's episodes, of one episode, and of all failures."""

from __future__ import annotations

from starlette.routing import Route

ROUTES: list[Route] = []
