import json
from dataclasses import dataclass
from typing import Any

import pytest
from django.test import Client

from evaweb.api.tokens import create_token
from tests.evaweb.trials import builders


@dataclass
class Rest:
    """A program with a token; every answer has to be JSON or CSV."""

    token: str = ""

    def _headers(self) -> dict[str, str]:
        return {"Authorization": f"Bearer {self.token}"} if self.token else {}

    def get(self, path: str, **query: Any) -> tuple[int, Any]:
        """Status and content of GET /api/v1/PATH."""
        answer = Client().get(f"/api/v1/{path}", query, headers=self._headers())
        return answer.status_code, answer.json()

    def csv(self, path: str, **query: Any) -> str:
        """The text of GET /api/v1/PATH?format=csv."""
        answer = Client().get(f"/api/v1/{path}", {**query, "format": "csv"}, headers=self._headers())
        assert answer["Content-Type"] == "text/csv; charset=utf-8"
        return b"".join(answer.streaming_content).decode()

    def post(self, path: str, **body: Any) -> tuple[int, Any]:
        """Status and content of POST /api/v1/PATH."""
        answer = Client().post(
            f"/api/v1/{path}", json.dumps(body), content_type="application/json", headers=self._headers()
        )
        return answer.status_code, answer.json()


@pytest.fixture(autouse=True)
def _data_dir(settings, tmp_path):
    settings.DATA_DIR = tmp_path


@pytest.fixture
def rest(bench):
    """With the operator's token."""
    return Rest(create_token(user=bench.operator, name="tests"))


@pytest.fixture
def viewer(bench):
    """With a viewer's token."""
    return Rest(create_token(user=builders.user("vic", "viewer"), name="tests"))
