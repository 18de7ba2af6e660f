"""Asks the web, whose PostgreSQL is away: of each METHOD, PATH, BODY, HEADERS given the answer, as a line of JSON."""

from __future__ import annotations

import asyncio
import json
import os
import sys

os.environ["DJANGO_SETTINGS_MODULE"] = "evaweb.settings"

from asgiref.testing import ApplicationCommunicator

from evaweb.asgi import application
from evaweb.core.lock_wait import limit_page_waits
from tests.processes import PATIENCE_S


async def answered(method: str, path: str, body: str, headers: dict[str, str]) -> dict[str, object]:
    """Status, content type and body."""
    given = {"host": "localhost", "content-type": "application/json", **headers}
    scope = {
        "type": "http",
        "http_version": "1.1",
        "method": method,
        "scheme": "http",
        "path": path,
        "raw_path": b"",
        "query_string": b"",
        "headers": [(name.encode(), value.encode()) for name, value in given.items()],
        "client": ("127.0.0.1", 1),
        "server": ("127.0.0.1", 80),
    }
    served = ApplicationCommunicator(application, scope)
    await served.send_input({"type": "http.request", "body": body.encode(), "more_body": False})
    start, content = await served.receive_output(PATIENCE_S), await served.receive_output(PATIENCE_S)
    named = {name.lower(): value.decode() for name, value in start["headers"]}
    return {"status": start["status"], "type": named[b"content-type"], "body": content["body"].decode()}


if __name__ == "__main__":
    limit_page_waits()
    for question in json.loads(sys.argv[1]):
        print(json.dumps(asyncio.run(answered(*question))), flush=True)
