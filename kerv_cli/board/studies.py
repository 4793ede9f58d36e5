"""The page of a study: its verdict, tables and plots."""

from __future__ import annotations

from starlette.routing import Route

ROUTES: list[Route] = []
