"""`kerv board`: its pages, what it refuses, and how fast it is."""

import pytest
from starlette.testclient import TestClient

from kerv_cli.board.app import make_app

HERE = "http://127.0.0.1"


@pytest.fixture
def client(tmp_path):
    with TestClient(make_app(tmp_path), base_url=HERE) as client:
        yield client


def test_other_hosts_and_other_origins_are_refused(client):
    assert client.get("/").status_code == 200
    assert client.get("/", headers={"host": "kerv.attacker.example"}).status_code == 400
    for origin in ("http://attacker.example", "null", "http://127.0.0.1:1", "http://127.0.0.1.attacker.example"):
        assert client.post("/", headers={"origin": origin}).status_code == 403
    for headers in ({}, {"origin": HERE}):
        assert client.post("/", headers=headers).status_code == 405
    assert client.get("/static/%2e%2e/app.py").status_code == 404
